"use strict";
// Sortable tables: a click on a head sorts the rows of each group, once more the other way.
const value = cell => {
  const text = cell.textContent.trim().replace(/\u2212/g, "-").replace(/,/g, "");
  const number = parseFloat(text);
  return Number.isNaN(number) ? text.toLowerCase() : number;
};
for (const table of document.querySelectorAll("table.sortable")) {
  [...table.tHead.rows].at(-1).querySelectorAll("th").forEach((head, column) => {
    const sort = () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of table.querySelectorAll("th[aria-sort]")) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      for (const body of table.tBodies) {
        const rows = [...body.rows].filter(row => !row.classList.contains("group"));
        const rank = row => value(row.cells[column]);
        rows.sort((a, b) => {
          const [x, y] = [rank(a), rank(b)];
          const order = typeof x === typeof y ? (x < y ? -1 : x > y ? 1 : 0) : typeof x === "number" ? -1 : 1;
          return down ? -order : order;
        });
        body.append(...rows);
      }
    };
    head.tabIndex = 0;
    head.addEventListener("click", sort);
    head.addEventListener("keydown", event => { if (event.key === "Enter") sort(); });
  });
}

// Filters: rows of the table below whose text does not hold the words are hidden.
for (const filter of document.querySelectorAll("input.filter")) {
  const rows = document.getElementById(filter.getAttribute("aria-controls")).querySelectorAll("tbody tr");
  filter.closest(".controls").hidden = false;
  filter.addEventListener("input", () => {
    const words = filter.value.toLowerCase().split(/\s+/);
    for (const row of rows) row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word));
  });
}

// Maps: images of numbers a model, (class low, class high, category), (VSS, OP, SBD) and, if something moved, its state;
// painted by layer.
const parsed = id => JSON.parse(document.getElementById(id)?.textContent ?? "null");
const layers = parsed("layers"), units = parsed("maps") ?? [];
const EMPTY = 255;
const RAMP = [[255, 255, 204], [255, 237, 160], [254, 217, 118], [254, 178, 76], [253, 141, 60], [252, 78, 42],
  [227, 26, 28], [189, 0, 38], [128, 0, 38]];
const COOL = [[0, 32, 77], [38, 66, 108], [87, 92, 109], [124, 123, 120], [166, 157, 117], [211, 193, 100], [255, 233, 69]];
const shade = (ramp, share) => {
  const at = Math.max(0, Math.min(1, share)) * (ramp.length - 1), low = Math.floor(at), high = Math.ceil(at), part = at - low;
  return ramp[low].map((channel, k) => Math.round(channel + (ramp[high][k] - channel) * part));
};
const NAMES = ["seen less than 3 times", "drifting", "uncertain", "stable"];
const MOST_OP = 20;

const pixels = source => new Promise((resolve, reject) => {
  const image = new Image();
  image.onload = () => {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    const context = canvas.getContext("2d", {willReadFrequently: true, colorSpace: "srgb"});
    context.drawImage(image, 0, 0);
    resolve(context.getImageData(0, 0, canvas.width, canvas.height).data);
  };
  image.onerror = reject;
  image.src = source;
});

const colorOf = (unit, layer, k) => {
  const [a, b] = [unit.first, unit.second];
  if (layer === "category" && unit.silent && a[k + 2]) {  // hatched, as agreement does not assess the map
    const at = k / 4, [x, y] = [at % unit.size[0], Math.floor(at / unit.size[0])];
    return (x + y) % 6 < 2 ? [120, 120, 120] : [225, 225, 225];
  }
  if (layer === "category") return layers.colors[a[k + 2]];
  if (layer === "class") return unit.palette[a[k] + 256 * a[k + 1]] ?? [128, 128, 128];
  if (layer === "moved") return layers.states[unit.third ? unit.third[k] : 0][0];
  if (layer === "op") return shade(COOL, Math.log(b[k + 1]) / Math.log(MOST_OP));
  if (b[k + 1] < 2) return [190, 190, 190];  // seen once: nothing could contradict it
  if (layer === "vss") return shade(RAMP, (255 - b[k]) / 127);
  return b[k + 2] === EMPTY ? [190, 190, 190] : shade(RAMP, b[k + 2] / 254);
};

const paint = (unit, layer) => {
  const {canvas} = unit, context = canvas.getContext("2d");
  unit.photo.hidden = layer !== "image";
  canvas.hidden = layer === "image";
  if (layer === "image") return;
  const image = context.createImageData(canvas.width, canvas.height);
  for (let k = 0; k < image.data.length; k += 4) {
    if (unit.first[k + 2] === EMPTY) continue;
    const color = colorOf(unit, layer, k);
    [image.data[k], image.data[k + 1], image.data[k + 2], image.data[k + 3]] = [...color, 255];
  }
  context.putImageData(image, 0, 0);
};

const swatch = (color, text) => `<span><i style="background:rgb(${color})"></i>${text}</span>`;
const escaped = text => text.replace(/[&<>"]/g, c => `&#${c.charCodeAt(0)};`);
const ramp = (colors, from, to) => `<span>${from} <i class="ramp" style="background:linear-gradient(to right,${
  colors.map(color => `rgb(${color})`)})"></i> ${to}</span>`;
const key = (own, layer) => {
  if (layer === "category") {
    const silent = own.filter(unit => unit.silent), names = silent.length < own.length ? NAMES : NAMES.slice(0, 1);
    return names.map((name, k) => swatch(layers.colors[k], name)).reverse().join("")
      + silent.map(unit => `<span><i class="hatched"></i>${escaped(unit.silent)}</span>`).join("");
  }
  if (layer === "moved") return layers.states.map(([color, name]) => swatch(color, name)).reverse().join("");
  if (layer === "op") return ramp(COOL, "seen once", `${MOST_OP} times or more`);
  if (layer === "vss") return ramp(RAMP, "frames agree", "half of the evidence disagrees") + swatch([190, 190, 190], "seen once");
  if (layer === "sbd") return ramp(RAMP, "0", `${layers.sbd} bits or more`) + swatch([190, 190, 190], "seen once");
  if (layer === "image") return `<span>The image of ${own[0].frame}</span>`;
  const counts = new Map();
  for (const unit of own) for (let k = 0; k < unit.first.length; k += 4) {
    const label = unit.first[k] + 256 * unit.first[k + 1];
    if (unit.first[k + 2] !== EMPTY) counts.set(label, (counts.get(label) ?? 0) + 1);
  }
  const common = [...counts].sort((x, y) => y[1] - x[1]).slice(0, 16).map(([label]) => label);
  return common.map(label => swatch(own[0].palette[label], escaped(own[0].names[label]))).join("")
    + (counts.size > 16 ? `<span>and ${counts.size - 16} more</span>` : "");
};

// The two coordinates that run along the map, those of the exports; shares count from its lower left corner.
const coordinates = (unit, across, up) => {
  const {matrix, size, names} = unit.located;
  const axes = [0, 1, 2].sort((a, b) => Math.max(...matrix[b].slice(0, 2).map(Math.abs)) - Math.max(...matrix[a].slice(0, 2).map(Math.abs)));
  const digits = Math.max(0, Math.min(2, Math.ceil(-Math.log10(unit.cell))));
  return axes.slice(0, 2).sort().map(k =>
    `${names[k]} ${(matrix[k][0] * across * size[0] + matrix[k][1] * up * size[1] + matrix[k][2]).toFixed(digits)}`).join(", ") + " m";
};

const read = (unit, event) => {
  const box = unit.canvas.getBoundingClientRect(), [width, height] = unit.size;
  const x = Math.floor((event.clientX - box.left) / box.width * width);
  const y = Math.floor((event.clientY - box.top) / box.height * height);
  const k = 4 * (y * width + x), at = coordinates(unit, (x + 0.5) / width, 1 - (y + 0.5) / height);
  if (x < 0 || y < 0 || x >= width || y >= height || unit.first[k + 2] === EMPTY) return unit.text;
  const op = unit.second[k + 1], label = unit.first[k] + 256 * unit.first[k + 1];
  const drift = unit.second[k + 2] === EMPTY ? "" : ` \u00b7 SBD ${(unit.second[k + 2] / 254 * layers.sbd).toFixed(3)} bits`;
  return `${unit.names[label]} \u00b7 ${NAMES[unit.first[k + 2]]} \u00b7 VSS ${(unit.second[k] / 255).toFixed(2)}`
    + ` \u00b7 OP ${op === 255 ? "255 or more" : op}${drift} \u00b7 ${at}`;
};

const pressed = (group, button) => {
  for (const other of group.querySelectorAll("button")) other.setAttribute("aria-pressed", String(other === button));
};

const start = async scene => {
  const figures = [...scene.querySelectorAll("figure.map")];
  const own = units.filter(unit => figures.includes(unit.figure));
  const buttons = scene.querySelector(".layers");
  if (!own.length || scene.dataset.painted) return;
  scene.dataset.painted = "1";
  for (const unit of own) {
    [unit.first, unit.second, unit.third] = await Promise.all(unit.numbers.map(pixels));
    unit.canvas = document.createElement("canvas");
    [unit.canvas.width, unit.canvas.height] = unit.size;
    unit.photo = new Image();
    unit.photo.src = unit.image || "data:,";
    unit.photo.alt = unit.frame;
    unit.photo.hidden = true;
    unit.figure.querySelector(".plain").replaceWith(unit.canvas, unit.photo);
    const readout = unit.figure.querySelector(".readout");
    const show = event => { readout.textContent = read(unit, event); };
    unit.canvas.addEventListener("pointermove", show);
    unit.canvas.addEventListener("pointerdown", show);
    unit.canvas.addEventListener("pointerleave", () => { readout.textContent = unit.text; });
  }
  scene.querySelector(".plain-key").hidden = true;
  buttons.hidden = false;
  const choose = button => {
    pressed(buttons, button);
    for (const unit of own) paint(unit, button.dataset.layer);
    scene.querySelector(".key").innerHTML = key(own, button.dataset.layer);
  };
  for (const button of buttons.querySelectorAll("button")) button.addEventListener("click", () => choose(button));
  choose(buttons.querySelector("button"));
  const models = scene.querySelector(".models");
  if (!models) return;
  models.hidden = false;
  const pick = button => {
    pressed(models, button);
    const model = button.dataset.model;
    own.forEach((unit, k) => { unit.figure.hidden = model !== "" && Number(model) !== k; });
    scene.querySelector(".maps").classList.toggle("one", model !== "");
  };
  for (const button of models.querySelectorAll("button")) button.addEventListener("click", () => pick(button));
  pick(models.querySelectorAll("button")[own.length > 2 ? 1 : 0]);
};

// Places: a number on the map opens what is known of the place, and an open one is marked on the map.
for (const place of document.querySelectorAll("details.place")) {
  const pin = document.querySelector(`a.pin[href="#${place.id}"]`);
  pin?.addEventListener("click", () => { place.open = true; });
  place.addEventListener("toggle", () => pin?.classList.toggle("open", place.open));
}

const scenes = [...document.querySelectorAll(".scene")];
{
  const all = [...document.querySelectorAll("figure.map")];
  units.forEach((unit, k) => { unit.figure = all[k]; });
}
const choice = document.getElementById("scene");
if (choice) {
  document.getElementById("scene-choice").hidden = false;
  const show = () => scenes.forEach((scene, k) => {
    scene.hidden = k !== choice.selectedIndex;
    if (!scene.hidden) start(scene);
  });
  choice.addEventListener("change", show);
  show();
} else {
  scenes.forEach(start);
}
