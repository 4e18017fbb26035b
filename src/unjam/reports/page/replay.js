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
    return { ...driver, canvas, mean, positions: numbers(driver.positions, Float32Array),
             speeds: numbers(driver.speeds, Float32Array), outline: driver.outline };
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

  function draw(road, time) {
    const size = road.canvas.clientWidth * (window.devicePixelRatio || 1);
    if (road.canvas.width !== Math.round(size)) road.canvas.width = road.canvas.height = Math.round(size);
    const xs = road.outline.map((point) => point[1]), ys = road.outline.map((point) => point[2]);
    const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const metre = size / (Math.max(right - left, high - low) + 12);
    const pen = road.canvas.getContext("2d");
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, size, size);
    pen.setTransform(metre, 0, 0, -metre, size / 2 - metre * (left + right) / 2, size / 2 + metre * (low + high) / 2);

    pen.beginPath();
    road.outline.forEach(([, x, y], index) => index ? pen.lineTo(x, y) : pen.moveTo(x, y));
    pen.lineWidth = 4; pen.strokeStyle = "#dfe3e8"; pen.stroke();

    const frame = Math.min(time / data.step, data.frames - 1);
    const first = Math.floor(frame), second = Math.min(first + 1, data.frames - 1), part = frame - first;
    let sum = 0;
    for (let vehicle = 0; vehicle < road.vehicles; vehicle++) {
      const [a, b] = [first * road.vehicles + vehicle, second * road.vehicles + vehicle];
      const position = road.positions[a] + part * (road.positions[b] - road.positions[a]);
      const speed = road.speeds[a] + part * (road.speeds[b] - road.speeds[a]);
      sum += speed;
      const middle = ((position - data.vehicle_length / 2) % road.loop_length + road.loop_length) % road.loop_length;
      const [x, y, angle] = place(road.outline, middle);
      pen.save();
      pen.translate(x, y);
      pen.rotate(angle);
      pen.fillStyle = colour(speed);
      pen.fillRect(-data.vehicle_length / 2, -1.2, data.vehicle_length, 2.4);
      if (road.cavs.includes(vehicle)) {
        pen.lineWidth = 0.8; pen.strokeStyle = "#d7263d";
        pen.strokeRect(-data.vehicle_length / 2 - 0.6, -1.8, data.vehicle_length + 1.2, 3.6);
      }
      pen.restore();
    }
    road.mean.textContent = `mean ${(sum / road.vehicles).toFixed(1)} m/s`;
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
