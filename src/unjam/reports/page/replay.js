// Replays the episodes of all drivers side by side, with vehicles colored by speed.
(async () => {
  const data = JSON.parse(document.getElementById("replay-data").textContent);
  const section = document.getElementById("replay");
  if (!section || !data.drivers.length) return;
  const find = (name) => section.querySelector(name);
  const [play, slider, clock, pace, zoom] = [".play", ".time", ".clock", ".pace", ".zoom"].map(find);

  // Decodes the values of all frames, with NaN for missing values, from compressed differences between frames.
  async function decode({ data: text, low, scale }, width) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const steps = new Uint16Array(await new Response(inflated).arrayBuffer());
    for (let index = width; index < steps.length; index++) steps[index] += steps[index - width];
    return Float32Array.from(steps, (step) => step === data.no_value ? NaN : low + scale * step);
  }
  async function addRoad(driver) {
    const figure = document.createElement("figure");
    const canvas = document.createElement("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Vehicles driven by ${driver.name}`);
    const caption = document.createElement("figcaption");
    const mean = document.createElement("small");
    caption.append(driver.name, mean);
    figure.append(canvas, caption);
    find(".roads").append(figure);
    const decodeAll = (name) => Promise.all((driver[name] || []).map((array) => decode(array, driver.vehicles)));
    const [[speeds], [positions], poses] = await Promise.all(["speeds", "positions", "poses"].map(decodeAll));
    return { ...driver, speeds, positions, poses, canvas, mean, cavs: new Set(driver.cavs) };
  }
  if (!window.DecompressionStream) {
    find(".roads").textContent = "The replay needs a browser from 2023 or later.";
    return;
  }
  const roads = [];
  for (const driver of data.drivers) roads.push(await addRoad(driver));
  const end = (data.frames - 1) * data.step;
  slider.max = end;

  const { colors } = data;
  const relative = (speed) => (speed - data.min_speed) / (data.max_speed - data.min_speed);
  const color = (speed) => colors[Math.max(0, Math.min(colors.length - 1, Math.round(relative(speed) * (colors.length - 1))))];
  find(".bar").style.background = `linear-gradient(to right, ${colors.join(",")})`;
  find(".min-speed").textContent = data.min_speed;
  find(".max-speed").textContent = data.max_speed;

  // Returns the position and direction in the plane for a coordinate along the route.
  function locate(outline, coordinate) {
    let low = 0, high = outline.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (outline[middle][0] <= coordinate) low = middle; else high = middle;
    }
    const [s0, x0, y0] = outline[low], [s1, x1, y1] = outline[high];
    const fraction = s1 > s0 ? (coordinate - s0) / (s1 - s0) : 0;
    return [x0 + fraction * (x1 - x0), y0 + fraction * (y1 - y0), Math.atan2(y1 - y0, x1 - x0)];
  }

  // Returns the value between two entries, those of a vehicle in two frames.
  const interpolate = (values, before, after, fraction) =>
    Number.isNaN(values[after]) ? values[before] : values[before] + fraction * (values[after] - values[before]);
  // Returns the center and direction of a vehicle between two entries.
  function pose(road, before, after, fraction) {
    if (road.positions) {
      const center = interpolate(road.positions, before, after, fraction) - data.vehicle_length / 2;
      return locate(road.lines[0], (center % road.loop_length + road.loop_length) % road.loop_length);
    }
    const [x, y] = road.poses.slice(0, 2).map((values) => interpolate(values, before, after, fraction));
    const angle = road.poses[2][before], half = data.vehicle_length / 2;
    return [x - half * Math.cos(angle), y - half * Math.sin(angle), angle];
  }

  function bounds(lines) {
    const box = [Infinity, -Infinity, Infinity, -Infinity];
    lines.forEach((line) => line.forEach(([, x, y]) => {
      box[0] = Math.min(box[0], x); box[1] = Math.max(box[1], x);
      box[2] = Math.min(box[2], y); box[3] = Math.max(box[3], y);
    }));
    return box;
  }

  roads.forEach((road) => {
    road.box = bounds(road.lines);
    const [left, right, low, high] = road.box;
    road.canvas.parentElement.classList.toggle("wide", right - left > 2 * (high - low));
  });

  // Center of the view of all roads, relative to the width and height of a road.
  const view = { x: 0.5, y: 0.5 };
  roads.forEach((road) => road.canvas.addEventListener("pointermove", (event) => {
    if (!event.buttons || zoom.value === "1") return;
    const move = (center, pixels, low, high) => Math.max(0, Math.min(1, center + pixels / road.meter / Math.max(high - low, 1)));
    view.x = move(view.x, -event.movementX, road.box[0], road.box[1]);
    view.y = move(view.y, event.movementY, road.box[2], road.box[3]);
    show();
  }));
  // Centers the view on the slowest vehicle, which is in a wave.
  function centerSlowest(road, frame) {
    const present = [...Array(road.vehicles).keys()].map((vehicle) => frame * road.vehicles + vehicle)
      .filter((index) => !Number.isNaN(road.speeds[index]));
    if (!present.length) return;
    const slowest = present.reduce((best, index) => road.speeds[index] < road.speeds[best] ? index : best);
    const [x, y] = pose(road, slowest, slowest, 0), [left, right, low, high] = road.box;
    [view.x, view.y] = [(x - left) / Math.max(right - left, 1), (y - low) / Math.max(high - low, 1)];
  }
  zoom.addEventListener("change", () => {
    view.x = view.y = 0.5;
    if (zoom.value !== "1") centerSlowest(roads[0], Math.floor(now / data.step));
    find(".roads").classList.toggle("zoomed", zoom.value !== "1");
    show();
  });

  function draw(road, time) {
    const [left, right, low, high] = road.box;
    const width = Math.round(road.canvas.clientWidth * (window.devicePixelRatio || 1));
    const meter = width / (right - left + 12);
    const factor = Number(zoom.value), across = high - low + 12;
    const top = road.merges.length ? 32 * (window.devicePixelRatio || 1) : 0;  // height of the labels of ramps
    const height = top + Math.round(Math.max(Math.min(1.2 * width, meter * across), Math.min(0.15 * width, factor * meter * across)));
    if (road.canvas.width !== width || road.canvas.height !== height) {
      road.canvas.width = width; road.canvas.height = height;
    }
    const scale = factor * Math.min(meter, (height - top) / across);
    const center = [left + view.x * (right - left), low + view.y * (high - low)];
    road.meter = scale / (window.devicePixelRatio || 1);
    const enlargement = Math.max(1, 6 * (window.devicePixelRatio || 1) / (scale * data.vehicle_length));
    const pen = road.canvas.getContext("2d");
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.setTransform(scale, 0, 0, -scale, width / 2 - scale * center[0], (height + top) / 2 + scale * center[1]);

    pen.beginPath();
    road.lines.forEach((line) => line.forEach(([, x, y], index) => index ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.lineWidth = Math.max(4, 1.5 / scale); pen.strokeStyle = "#dfe3e8"; pen.stroke();

    road.merges.forEach(([x, y]) => {
      pen.save();
      pen.translate(x, y);
      pen.scale(1 / road.meter, -1 / road.meter);  // in pixels of the page
      pen.fillStyle = "#495057"; pen.font = "11px sans-serif"; pen.textAlign = "center";
      pen.beginPath(); pen.moveTo(0, -6); pen.lineTo(-5, -14); pen.lineTo(5, -14); pen.fill();
      pen.fillText("ramp", 0, -17);
      pen.restore();
    });

    const frame = Math.min(time / data.step, data.frames - 1);
    const first = Math.floor(frame), second = Math.min(first + 1, data.frames - 1), fraction = frame - first;
    let sum = 0, count = 0;
    for (let vehicle = 0; vehicle < road.vehicles; vehicle++) {
      const [before, after] = [first * road.vehicles + vehicle, second * road.vehicles + vehicle];
      if (Number.isNaN(road.speeds[before])) continue;
      const speed = interpolate(road.speeds, before, after, fraction);
      sum += speed;
      count += 1;
      const [x, y, angle] = pose(road, before, after, fraction);
      pen.save();
      pen.translate(x, y);
      pen.rotate(angle);
      pen.scale(enlargement, enlargement);
      pen.fillStyle = color(speed);
      pen.fillRect(-data.vehicle_length / 2, -1.2, data.vehicle_length, 2.4);
      if (road.cavs.has(vehicle)) {
        pen.lineWidth = 0.8; pen.strokeStyle = "#d7263d";
        pen.strokeRect(-data.vehicle_length / 2 - 0.6, -1.8, data.vehicle_length + 1.2, 3.6);
      }
      pen.restore();
    }
    road.mean.textContent = count ? `mean now ${(sum / count).toFixed(1)} m/s` : "no vehicle on the road";
  }

  let now = 0, isPlaying = false, last = 0;  // time [s] and time of the last drawing [ms]
  function show() {
    slider.value = now;
    clock.textContent = `${Math.round(now)} s`;
    roads.forEach((road) => draw(road, now));
  }
  function tick(stamp) {
    if (!isPlaying) return;
    now = Math.min(end, now + (stamp - last) / 1000 * Number(pace.value));
    last = stamp;
    show();
    if (now >= end) setPlaying(false); else requestAnimationFrame(tick);
  }
  function setPlaying(value) {
    isPlaying = value;
    play.textContent = isPlaying ? "Pause" : "Play";
    play.setAttribute("aria-label", play.textContent);
    if (!value) return;
    if (now >= end) now = 0;
    last = performance.now();
    requestAnimationFrame(tick);
  }
  play.addEventListener("click", () => setPlaying(!isPlaying));
  slider.addEventListener("input", () => { now = Number(slider.value); show(); });
  window.addEventListener("resize", show);
  now = Math.min(data.start, end);
  show();
  section.classList.add("ready");
})();
