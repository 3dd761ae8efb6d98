// What the file holds, unpacked: numbers in D, arrays in typed arrays. User text is only ever set as textContent.

const $ = (id) => document.getElementById(id);
const D = JSON.parse($("data").textContent);
const F = D.frames, N = D.drawn;

function plea(text) {
  $("plea").textContent = text;
  $("plea").hidden = false;
}

function make(tag, text, name) {
  const node = document.createElement(tag);
  if (text !== undefined) node.textContent = text;
  if (name) node.className = name;
  return node;
}

function draw_svg(tag, attributes, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  return node;
}

function bytes_of(name) {
  const node = $("block-" + name), text = node.textContent;
  node.remove(); // the text is not needed again
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out;
}

async function inflate(name) {
  const stream = new Blob([bytes_of(name)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// (frames, width) integers: low bytes, then high bytes, of zigzag differences in time.
async function series(name, width) {
  const planes = await inflate(name), total = planes.length / 2, out = new Int16Array(total);
  for (let i = 0; i < total; i++) {
    const z = planes[i] | (planes[total + i] << 8);
    out[i] = ((z >> 1) ^ -(z & 1)) + (i < width ? 0 : out[i - width]);
  }
  return out;
}

async function bits(name, total) {
  const packed = await inflate(name), out = new Uint8Array(total);
  for (let i = 0; i < total; i++) out[i] = (packed[i >> 3] >> (7 - (i & 7))) & 1;
  return out;
}

const A = { points: null, xy: null, seen: null, known: null, spread: null, film: null };

async function unpack() {
  if (typeof DecompressionStream === "undefined") throw new Error("This browser is too old for this page (2023 or newer is needed).");
  [A.points, A.xy, A.seen, A.known] = await Promise.all([
    series("points", 3 * N), series("xy", 2 * N), bits("seen", F * N), bits("known", F * N),
  ]);
  if (D.spread) A.spread = await series("spread", 6 * D.spread.points.length);
  if (D.film) A.film = bytes_of("film");
}

// Number with two or three significant digits, no exponent.
function short(value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  if (size < 1e-6) return "0";
  return size >= 100 ? value.toFixed(0) : size >= 10 ? value.toFixed(1) : size >= 0.01 ? value.toFixed(2) : value.toPrecision(2);
}

const with_unit = (value, unit) => short(value) + (unit && value !== null ? "\u202f" + unit : "");
const name_of = (point) => (D.names ? D.names[point] : "track " + D.ids[point]);

const S = {
  frame: 0, playing: false, speed: 1,
  yaw: 0.6, pitch: 0.25, zoom: 1, preset: null,
  tracks: true, trails: true, model: false, spread: false, still: false, mirrored: false,
  chosen: -1,
};

const dark = matchMedia("(prefers-color-scheme: dark)");
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
