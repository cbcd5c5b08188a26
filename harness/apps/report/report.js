"use strict";
// The page's tables, contents and runs. Everything works on text: nothing from a results folder is read as markup.
const data = JSON.parse(document.getElementById("data").textContent);
const FIRST_ROWS = 25;

function filled(made, text, attributes) {
  made.textContent = text;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}
const element = (name, text, attributes = {}) => filled(document.createElement(name), text, attributes);
const drawn = (name, attributes, text = "") => filled(document.createElementNS("http://www.w3.org/2000/svg", name), text, attributes);

// Contents: always open beside the page, folded above it.
const contents = document.querySelector("nav details");
const wide = window.matchMedia("(min-width: 1200px)");
const fold = () => { contents.open = wide.matches; };
wide.addEventListener("change", fold);
fold();
contents.addEventListener("click", (event) => { if (event.target.closest("a") && !wide.matches) contents.open = false; });
const links = new Map([...contents.querySelectorAll("a")].map((a) => [a.hash.slice(1), a]));
const seen = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    if (!entry.isIntersecting) continue;
    for (const [name, link] of links) link.classList.toggle("here", name === entry.target.id);
  }
}, { rootMargin: "0px 0px -75% 0px" });
for (const name of links.keys()) seen.observe(document.getElementById(name));

// All runs: the first rows of those that the filter leaves, until all are asked for.
const runTable = document.getElementById("run-table");
const filter = document.getElementById("filter");
const more = document.getElementById("more");
let all = false;

function choose() {
  const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
  const rows = [...runTable.tBodies[0].rows].filter((row) => row.className !== "detail");
  let found = 0;
  for (const row of rows) {
    const text = row.textContent.toLowerCase();
    const wanted = words.every((word) => text.includes(word));
    found += wanted;
    row.hidden = !wanted || (!all && found > FIRST_ROWS);
  }
  document.getElementById("count").textContent = `${found} of ${rows.length} runs`;
  more.hidden = all || found <= FIRST_ROWS;
  more.textContent = `show all ${found}`;
}
filter.addEventListener("input", choose);
runTable.addEventListener("sorted", choose);
more.addEventListener("click", () => { all = true; choose(); });
choose();

// A run: its error over time, beside those of its method in the same place, and its measures.
function ticksOf(low, high) {
  const found = [];
  for (let e = Math.floor(Math.log10(low)); e <= Math.ceil(Math.log10(high)); e += 1) {
    const steps = high / low < 100 ? [1, 2, 5] : [1];
    for (const step of steps) if (step * 10 ** e >= low * 0.999 && step * 10 ** e <= high * 1.001) found.push(step * 10 ** e);
  }
  return found;
}

function curveOf(number, width) {
  const own = data.curves[number];
  const place = data.runs[number].place;
  const others = Object.keys(data.curves).filter((key) => key !== number && data.runs[key] && data.runs[key].place === place);
  const values = [own, ...others.map((key) => data.curves[key])].flatMap((c) => c.error).filter((v) => v > 0);
  const [left, right, top, bottom, height] = [56, 12, 12, 38, 260];
  const svg = drawn("svg", { class: "drawn", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "error over time" });
  const low = Math.min(...values), high = Math.max(...values, low * 10), end = Math.max(own.end, ...others.map((k) => data.curves[k].end));
  const x = (t) => left + (width - left - right) * (t / (end || 1));
  const y = (v) => top + (height - top - bottom) * (1 - Math.log(v / low) / Math.log(high / low));
  const line = (name, d, more = {}) => svg.append(drawn("path", { class: name, d, ...more }));
  const label = (text, at, level, anchor, more = {}) => svg.append(drawn("text", { class: "tick", x: at, y: level, "text-anchor": anchor, ...more }, text));
  for (const tick of ticksOf(low, high)) {
    line("grid", `M${left} ${y(tick)}H${width - right}`);
    label(String(Number(tick.toPrecision(1))), left - 6, y(tick) + 4, "end");
  }
  ["start", "middle", "middle", "middle", "end"].forEach((anchor, i) => {
    const t = (end * i) / 4;
    label(String(Number(t.toPrecision(3))), x(t), height - 20, anchor);
  });
  line("axis", `M${left} ${top}V${height - bottom}H${width - right}`);
  label("time [s]", (left + width) / 2, height - 4, "middle");
  label(`true error [${own.unit}]`, 12, height / 2, "middle", { transform: `rotate(-90 12 ${height / 2})` });
  const path = (curve) => {
    let d = "", pen = "M";
    curve.error.forEach((v, i) => {
      if (!(v > 0)) { pen = "M"; return; }
      d += `${pen}${x((curve.end * i) / Math.max(1, curve.error.length - 1)).toFixed(1)} ${y(v).toFixed(1)}`;
      pen = "L";
    });
    return d;
  };
  for (const key of others) line("others", path(data.curves[key]));
  const band = data.runs[number].band;
  if (band >= low && band <= high) line("band", `M${left} ${y(band)}H${width - right}`);
  line("own", path(own), { stroke: (data.swatches[data.runs[number].controller] ?? {}).colour ?? "#000" });
  return svg;
}

function openRun(number) {
  const row = document.getElementById(`run-${number}`);
  for (const open of runTable.querySelectorAll(".detail")) open.remove();
  if (!row || !data.runs[number]) return;
  row.hidden = false;
  const run = data.runs[number];
  const line = runTable.tBodies[0].insertRow([...runTable.tBodies[0].rows].indexOf(row) + 1);
  line.className = "detail";
  const cell = line.insertCell();
  cell.colSpan = row.cells.length;
  cell.append(element("h4", run.id));
  if (run.reason) cell.append(element("p", run.reason));
  const known = data.curves[number];
  const drawing = "Coloured: this run. Grey: the other seeds of this controller in the same place. Dashed: settling band.";
  if (known) cell.append(curveOf(number, Math.max(280, cell.clientWidth - 12)));
  cell.append(element("p", known ? drawing : "The steps of this run are not in the page.", { class: "key" }));
  const list = element("dl", "");
  data.measures.forEach((name, i) => {
    if (run.values[i] !== null) list.append(element("dt", name), element("dd", String(run.values[i])));
  });
  cell.append(list);
}

function follow() {
  const match = /^#run-(\d+)$/.exec(location.hash);
  if (!match) return;
  openRun(match[1]);
  document.getElementById(`run-${match[1]}`)?.scrollIntoView({ block: "start" });
}
window.addEventListener("hashchange", follow);
runTable.addEventListener("click", (event) => {
  const link = event.target.closest("a");
  if (link && link.hash === location.hash) { event.preventDefault(); follow(); }
});
follow();
