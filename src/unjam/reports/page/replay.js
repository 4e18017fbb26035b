// Plays the shown episodes side by side: vehicles on their road, coloured by speed.
(() => {
  const data = JSON.parse(document.getElementById("replay-data").textContent);
  const section = document.getElementById("replay");
  if (!section || !data.drivers.length) return;
  const find = (name) => section.querySelector(name);
  const [play, slider, clock, pace] = [".play", ".time", ".clock", ".pace"].map(find);

  const numbers = (text, Kind) => new Kind(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
  const roads = data.drivers.map((driver) => {
    const figure = document.createElement("figure");
    const canvas = document.createElement("canvas");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Vehicles driven by ${driver.name}`);
    const caption = document.createElement("figcaption");
    const mean = document.createElement("small");
    caption.append(driver.name, mean);
    figure.append(canvas, caption);
    find(".roads").append(figure);
    const arrays = Object.fromEntries(["positions", "places", "speeds"].filter((name) => driver[name])
      .map((name) => [name, numbers(driver[name], Float32Array)]));
    return { ...driver, ...arrays, canvas, mean, cavs: new Set(driver.cavs) };
  });
  const end = (data.frames - 1) * data.step;
  slider.max = end;

  const table = data.colours;
  const colour = (speed) => table[Math.max(0, Math.min(table.length - 1, Math.round(speed / data.fastest * (table.length - 1))))];
  find(".bar").style.background = `linear-gradient(to right, ${table.join(",")})`;
  find(".fastest").textContent = data.fastest;

  // Where on the plane a coordinate along the route lies, and which way it points.
  function place(outline, coordinate) {
    let low = 0, high = outline.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (outline[middle][0] <= coordinate) low = middle; else high = middle;
    }
    const [s0, x0, y0] = outline[low], [s1, x1, y1] = outline[high];
    const part = s1 > s0 ? (coordinate - s0) / (s1 - s0) : 0;
    return [x0 + part * (x1 - x0), y0 + part * (y1 - y0), Math.atan2(y1 - y0, x1 - x0)];
  }

  // Where a vehicle's middle is between two frames, and which way it points; nothing where it is not there.
  function spot(road, a, b, part) {
    const mix = (values, width, index) => {
      const [from, to] = [values[a * width + index], values[b * width + index]];
      return Number.isNaN(to) ? from : from + part * (to - from);
    };
    if (road.positions) {
      const middle = mix(road.positions, 1, 0) - data.vehicle_length / 2;
      return place(road.lines[0], (middle % road.loop_length + road.loop_length) % road.loop_length);
    }
    const angle = road.places[3 * a + 2], half = data.vehicle_length / 2;
    return [mix(road.places, 3, 0) - half * Math.cos(angle), mix(road.places, 3, 1) - half * Math.sin(angle), angle];
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

  function draw(road, time) {
    const [left, right, low, high] = road.box;
    const width = Math.round(road.canvas.clientWidth * (window.devicePixelRatio || 1));
    const metre = width / (right - left + 12);
    const height = Math.round(Math.min(1.2 * width, metre * (high - low + 12)));
    if (road.canvas.width !== width || road.canvas.height !== height) {
      road.canvas.width = width; road.canvas.height = height;
    }
    const scale = Math.min(metre, height / (high - low + 12));
    const enlarged = Math.max(1, 6 * (window.devicePixelRatio || 1) / (scale * data.vehicle_length));
    const pen = road.canvas.getContext("2d");
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.setTransform(scale, 0, 0, -scale, width / 2 - scale * (left + right) / 2, height / 2 + scale * (low + high) / 2);

    pen.beginPath();
    road.lines.forEach((line) => line.forEach(([, x, y], index) => index ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.lineWidth = Math.max(4, 1.5 / scale); pen.strokeStyle = "#dfe3e8"; pen.stroke();

    const frame = Math.min(time / data.step, data.frames - 1);
    const first = Math.floor(frame), second = Math.min(first + 1, data.frames - 1), part = frame - first;
    let sum = 0, there = 0;
    for (let vehicle = 0; vehicle < road.vehicles; vehicle++) {
      const [a, b] = [first * road.vehicles + vehicle, second * road.vehicles + vehicle];
      if (Number.isNaN(road.speeds[a])) continue;
      const later = Number.isNaN(road.speeds[b]) ? road.speeds[a] : road.speeds[b];
      const speed = road.speeds[a] + part * (later - road.speeds[a]);
      sum += speed;
      there += 1;
      const [x, y, angle] = spot(road, a, b, part);
      pen.save();
      pen.translate(x, y);
      pen.rotate(angle);
      pen.scale(enlarged, enlarged);
      pen.fillStyle = colour(speed);
      pen.fillRect(-data.vehicle_length / 2, -1.2, data.vehicle_length, 2.4);
      if (road.cavs.has(vehicle)) {
        pen.lineWidth = 0.8; pen.strokeStyle = "#d7263d";
        pen.strokeRect(-data.vehicle_length / 2 - 0.6, -1.8, data.vehicle_length + 1.2, 3.6);
      }
      pen.restore();
    }
    road.mean.textContent = there ? `mean ${(sum / there).toFixed(1)} m/s` : "nobody on the road";
  }

  let now = 0, playing = false, last = 0;
  function show() {
    slider.value = now;
    clock.textContent = `${Math.round(now)} s`;
    roads.forEach((road) => draw(road, now));
  }
  function tick(stamp) {
    if (!playing) return;
    now = Math.min(end, now + (stamp - last) / 1000 * Number(pace.value));
    last = stamp;
    show();
    if (now >= end) set(false); else requestAnimationFrame(tick);
  }
  function set(on) {
    playing = on;
    play.textContent = on ? "Pause" : "Play";
    play.setAttribute("aria-label", play.textContent);
    if (!on) return;
    if (now >= end) now = 0;
    last = performance.now();
    requestAnimationFrame(tick);
  }
  play.addEventListener("click", () => set(!playing));
  slider.addEventListener("input", () => { now = Number(slider.value); show(); });
  window.addEventListener("resize", show);
  now = Math.min(data.start, end);
  show();
})();
