"use strict";
// Paths in space on a canvas, turned by the pointer: a box with its scales, the reference, and a line a controller.
(function space() {
  const canvas = document.getElementById("space-canvas");
  if (!canvas) return;
  const pen = canvas.getContext("2d");
  const { views, swatches } = JSON.parse(document.getElementById("data").textContent);
  const choice = document.getElementById("space-choice");
  const names = document.getElementById("space-names");
  const hidden = new Set();
  let eye = { turn: 0.35, tilt: 0.3, zoom: 1 }, view = views[0], box = null;

  function measure() {
    const points = [...view.reference, ...view.start, ...Object.values(view.paths).flat()];
    const low = [0, 1, 2].map((i) => Math.min(...points.map((p) => p[i])));
    const high = [0, 1, 2].map((i) => Math.max(...points.map((p) => p[i])));
    const widest = Math.max(...high.map((h, i) => h - low[i]), 1e-9);
    for (let i = 0; i < 3; i += 1) {
      const missing = Math.max(0, 0.25 * widest - (high[i] - low[i])) / 2 + 0.04 * widest;
      low[i] -= missing;
      high[i] += missing;
    }
    box = { low, high, middle: low.map((l, i) => (l + high[i]) / 2), radius: Math.hypot(...high.map((h, i) => h - low[i])) / 2 };
  }

  function project(p) {
    const [x, y, z] = p.map((v, i) => (v - box.middle[i]) / box.radius);
    const x1 = x * Math.cos(eye.turn) - z * Math.sin(eye.turn);
    const z1 = x * Math.sin(eye.turn) + z * Math.cos(eye.turn);
    const y2 = y * Math.cos(eye.tilt) - z1 * Math.sin(eye.tilt);
    const depth = y * Math.sin(eye.tilt) + z1 * Math.cos(eye.tilt);
    const scale = (0.43 * Math.min(canvas.clientWidth, canvas.clientHeight * 1.15) * eye.zoom) / (1 + 0.18 * depth);
    return [canvas.clientWidth / 2 + x1 * scale, canvas.clientHeight / 2 + y2 * scale, depth];
  }

  function line(points, colour, width, dash = []) {
    pen.beginPath();
    points.forEach((p, i) => { const [x, y] = project(p); if (i) pen.lineTo(x, y); else pen.moveTo(x, y); });
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.setLineDash(dash);
    pen.stroke();
    pen.setLineDash([]);
  }

  const corner = (bits) => [0, 1, 2].map((i) => ((bits >> i) & 1 ? box.high[i] : box.low[i]));

  function niceTicks(low, high) {
    const step = 10 ** Math.floor(Math.log10((high - low) / 2));
    const every = [1, 2, 5, 10].map((k) => k * step).find((s) => (high - low) / s <= 4.5);
    const found = [];
    for (let k = Math.ceil(low / every); k * every <= high; k += 1) found.push(Number((k * every).toPrecision(6)));
    return found;
  }

  // Texts of which none covers another: the names of the axes come first, then the numbers for which there is room.
  const taken = [];

  function write(text, x, y, across) {
    const width = pen.measureText(text).width;
    const left = Math.min(Math.max(x - { right: width, center: width / 2, left: 0 }[across], 4), canvas.clientWidth - width - 4);
    const place = { left: left - 3, right: left + width + 3, top: y - 8, bottom: y + 8 };
    if (taken.some((other) => place.left < other.right && other.left < place.right && place.top < other.bottom && other.top < place.bottom)) return;
    taken.push(place);
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    pen.fillText(text, left, y);
  }

  // Of the four parallel edges of the box, an axis has its scale at the outermost low one, so that scales stay apart.
  function drawBox() {
    for (let a = 0; a < 8; a += 1) for (let i = 0; i < 3; i += 1) if (!((a >> i) & 1)) line([corner(a), corner(a | (1 << i))], "#d5d5d5", 1);
    const centre = project(box.middle);
    const scales = [0, 1, 2].map((i) => {
      const edges = [0, 1, 2, 3].map((k) => {
        const [j, l] = [0, 1, 2].filter((n) => n !== i);
        const start = ((k & 1) << j) | (((k >> 1) & 1) << l);
        const ends = [corner(start), corner(start | (1 << i))];
        const [p, q] = ends.map(project);
        const middle = [(p[0] + q[0]) / 2, (p[1] + q[1]) / 2];
        return { ends, middle, rank: i === 1 ? -middle[0] : middle[1] + 0.001 * middle[0] };
      });
      const { ends, middle } = edges.reduce((best, edge) => (edge.rank > best.rank ? edge : best));
      line(ends, "#666", 1.4);
      const away = [middle[0] - centre[0], middle[1] - centre[1]];
      const length = Math.hypot(...away) || 1;
      return { ends, middle, out: away.map((v) => v / length) };
    });
    taken.length = 0;
    pen.fillStyle = "#333";
    pen.font = "bold 13px system-ui, sans-serif";
    scales.forEach(({ middle, out }, i) => {
      const y = Math.min(Math.max(middle[1] + 34 * out[1], 10), canvas.clientHeight - 10);
      write(view.axes[i], middle[0] + 58 * out[0], y, "center");
    });
    pen.font = "12px system-ui, sans-serif";
    scales.forEach(({ ends, out }, i) => {
      for (const tick of niceTicks(box.low[i], box.high[i])) {
        const at = [...ends[0]];
        at[i] = tick;
        const [x, y] = project(at);
        write(String(tick), x + 12 * out[0], y + 12 * out[1], out[0] < -0.3 ? "right" : out[0] > 0.3 ? "left" : "center");
      }
    });
  }

  function mark(point, text, filled) {
    const [x, y] = project(point);
    pen.fillStyle = filled ? "#000" : "#fff";
    pen.fillRect(x - 5, y - 5, 10, 10);
    pen.strokeStyle = "#000";
    pen.lineWidth = 1.6;
    pen.strokeRect(x - 5, y - 5, 10, 10);
    pen.fillStyle = "#000";
    pen.fillText(text, x + 9, y - 8);
  }

  function paint() {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    drawBox();
    if (view.reference.length > 1) line(view.reference, "rgba(0,0,0,.25)", 8);
    for (const [name, path] of Object.entries(view.paths)) {
      if (!hidden.has(name)) line(path, swatches[name].colour, 2.2, swatches[name].dash);
    }
    if (view.reference.length === 1) mark(view.reference[0], "target", true);
    if (view.start.length) mark(view.start[0], "start", false);
  }

  function list() {
    names.replaceChildren(...Object.keys(view.paths).map((name) => {
      const label = element("label", "");
      const box = element("input", "", { type: "checkbox" });
      box.checked = !hidden.has(name);
      box.addEventListener("change", () => { hidden[box.checked ? "delete" : "add"](name); paint(); });
      const swatch = drawn("svg", { class: "swatch", viewBox: "0 0 30 12" });
      swatch.append(drawn("path", { d: "M0 6H30", stroke: swatches[name].colour, "stroke-width": 2.6, "stroke-dasharray": swatches[name].dash.join(" ") }));
      label.append(box, swatch, document.createTextNode(name));
      return label;
    }));
  }

  function show(index) {
    view = views[index];
    measure();
    list();
    paint();
  }

  views.forEach((one, i) => choice.append(element("option", one.title, { value: String(i) })));
  choice.addEventListener("change", () => show(Number(choice.value)));
  const zoom = (factor) => () => { eye.zoom = Math.min(6, Math.max(0.4, eye.zoom * factor)); paint(); };
  document.getElementById("space-nearer").addEventListener("click", zoom(1.25));
  document.getElementById("space-further").addEventListener("click", zoom(0.8));
  document.getElementById("space-reset").addEventListener("click", () => { eye = { turn: 0, tilt: 0, zoom: 1 }; paint(); });
  function turn(across, down) {
    eye.turn += across;
    eye.tilt = Math.min(1.57, Math.max(-1.57, eye.tilt + down));
    paint();
  }
  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons & 1) turn(event.movementX * 0.008, event.movementY * 0.008);
  });
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
    if (!step) return;
    event.preventDefault();
    turn(...step);
  });
  window.addEventListener("resize", paint);
  show(0);
}());
