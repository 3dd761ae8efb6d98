// State, playing, keys and words.

// What has to be drawn again: nothing, the shape alone, or everything. A turn of the shape leaves the film as it is.
const NOTHING = 0, SHAPE = 1, ALL = 2;
let stale = NOTHING, since = 0;

function refresh() { stale = ALL; }
function refresh_shape() { stale = Math.max(stale, SHAPE); }

function seek(frame) {
  S.frame = Math.max(0, Math.min(F - 1, frame));
  since = performance.now() - (1000 * D.times[S.frame]) / S.speed;
  refresh();
}

function play(on) {
  if (on && S.frame === F - 1) seek(0);
  S.playing = on && F > 1;
  since = performance.now() - (1000 * D.times[S.frame]) / S.speed;
  $("play-icon").setAttribute("d", S.playing ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5v14l11-7z");
  $("play").setAttribute("aria-label", S.playing ? "Pause" : "Play");
}

function advance(now) {
  const time = ((now - since) * S.speed) / 1000;
  let frame = S.frame;
  while (frame < F - 1 && D.times[frame + 1] <= time) frame++;
  if (frame !== S.frame) { S.frame = frame; refresh(); }
  if (frame === F - 1 && time > D.times[F - 1] + 0.4) seek(0); // again from the start, after a breath
}

function say(text) { $("said").textContent = text; }

function choose(point) {
  S.chosen = point;
  const seen = point < 0 ? [] : Array.from({ length: F }, (_, f) => A.seen[f * N + point]);
  const count = seen.reduce((a, b) => a + b, 0), gaps = seen.filter((v, f) => !v && f && seen[f - 1]).length;
  $("chosen").textContent = point < 0 ? "Click a point or a row to follow one track."
    : `${name_of(point)}: seen in ${count} of ${F} frames` + (gaps ? `, lost ${gaps}\u00d7` : "");
  charts.recolour();
  refresh();
}

const toggles = {
  tracks: "tool-tracks", trails: "tool-trails", model: "tool-model",
  spread: "tool-spread", still: "tool-still", mirrored: "tool-mirror",
};
const spoken = {
  mirrored: ["Mirrored answer", "Chosen answer"], spread: ["Uncertainty shown", "Uncertainty hidden"],
  still: ["Body held still", "Body turns"],
};

function toggle(name) {
  const button = $(toggles[name]);
  if (button.disabled) { say(button.title); return; }
  S[name] = !S[name];
  button.setAttribute("aria-pressed", S[name]);
  if (spoken[name]) say(spoken[name][S[name] ? 0 : 1]);
  const flags = [S.mirrored && "mirrored answer", S.still && "held still"].filter(Boolean);
  $("flag").textContent = flags.join(" · ");
  $("flag").hidden = !flags.length;
  $("model-key").hidden = !S.model;
  refresh();
}

function show_view() {
  for (const name of Object.keys(scene.PRESETS)) $("view-" + name).setAttribute("aria-pressed", S.preset === name);
}

let glide = 0;
function look_from(yaw, pitch, name) {
  const from = [S.yaw, S.pitch, S.zoom], start = performance.now(), mine = ++glide, length = calm.matches ? 0 : 260;
  S.preset = name;
  show_view();
  const step = (now) => {
    if (mine !== glide || S.preset !== name) return;
    const t = length ? Math.min(1, (now - start) / length) : 1, s = t * t * (3 - 2 * t);
    S.yaw = from[0] + s * (yaw - from[0]);
    S.pitch = from[1] + s * (pitch - from[1]);
    S.zoom = from[2] + s * (1 - from[2]);
    refresh_shape();
    if (t < 1) requestAnimationFrame(step);
  };
  step(start);
}

function preset(name) {
  look_from(...scene.PRESETS[name], name);
  say(name + " view");
}

const keys = {
  " ": () => play(!S.playing),
  ArrowLeft: () => { play(false); seek(S.frame - 1); },
  ArrowRight: () => { play(false); seek(S.frame + 1); },
  Home: () => seek(0),
  End: () => seek(F - 1),
  1: () => preset("front"), 2: () => preset("side"), 3: () => preset("top"),
  0: () => look_from(0.6, 0.25, null),
  "+": () => scene.zoom(1.2), "=": () => scene.zoom(1.2), "-": () => scene.zoom(1 / 1.2),
  m: () => toggle("mirrored"), u: () => toggle("spread"), h: () => toggle("still"),
  Escape: () => choose(-1),
};
const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const field = event.target, key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (event.shiftKey && turns[key]) {
    scene.turn(...turns[key]);
    event.preventDefault();
    return;
  }
  // A focused control keeps the keys that work it: the slider its arrows, a button its space bar.
  if (field.matches("select, summary, pre") && key !== "Escape") return;
  if (field.matches("input") && /^(Arrow|Home|End|Page)/.test(key)) return;
  if (field.matches("button") && key === " ") return;
  if (!keys[key]) return;
  keys[key]();
  event.preventDefault();
});

function words() {
  $("title").textContent = D.title;
  const last = D.times[F - 1] || 0, rate = F > 1 ? (F - 1) / last : D.fps;
  $("subtitle").textContent = `${F} frames · ${short(last)}\u202fs · ${Number(rate.toFixed(2))} frames per second`;
  $("verdict").classList.add(D.status.ok ? "good" : "open");
  $("headline").textContent = D.status.headline + ".";
  $("status").textContent = D.status.text.replace(/^./, (c) => c.toUpperCase()) + (/[.!?]$/.test(D.status.text) ? "" : ".");
  const degree = D.rank.degree === null ? "–" : String(Number(D.rank.degree.toFixed(2)));
  const facts = [["Shape bases K", D.rank.k], ["Deformation degree", degree], ["Points", D.points],
    ["Unit of length", { px: "pixels", m: "metres", u: "up to scale" }[D.unit]]];
  for (const [name, value] of facts) {
    const pair = make("div");
    pair.append(make("dt", name), make("dd", String(value)));
    $("facts").append(pair);
  }
  for (const word of D.words) {
    const item = make("li", undefined, word.kind);
    item.append(make("strong", word.title), make("span", word.text));
    $("words").append(item);
  }
  for (const text of D.absent) {
    const [what, why] = [text.slice(0, text.indexOf(":")), text.slice(text.indexOf(":") + 1)], item = make("li");
    item.append(make("strong", what), why);
    $("absent").append(item);
  }
  $("absent-part").hidden = !D.absent.length;
  const e = D.rank.estimate;
  $("rank-words").textContent = e
    ? `The tracks show K = ${e.k}` + (e.interval[0] < e.interval[1] ? `, and do not rule out ${e.interval[0]} to ${e.interval[1]}` : "") +
      `. Rule ${e.rule.replaceAll("_", " ")}, layout ${e.layout}.` + (e.k === D.rank.k ? "" : ` Solved with K = ${D.rank.k}.`)
    : `Solved with K = ${D.rank.k}. The tracks, which were not given, hold the evidence for it.`;
  $("command").textContent = D.made.command || "Not recorded.";
  for (const [name, version] of Object.entries(D.made.versions)) $("versions").append(make("span", `${name} ${version}`));
  const settings = Object.keys(D.made.settings).length;
  $("settings-part").hidden = !settings;
  if (settings) $("settings").textContent = JSON.stringify(D.made.settings, null, 1);
}

function dress() {
  $("film-title").textContent = D.film ? "Film" : D.tracked ? "Tracks" : "Seen from the camera";
  const deny = (name, why) => {
    const button = $(toggles[name]);
    button.disabled = true;
    button.title = why;
    button.setAttribute("aria-pressed", S[name] = false);
  };
  if (!D.tracked) { deny("trails", "No tracks were given."); deny("model", "No tracks were given."); }
  if (!D.spread) deny("spread", "This solver gives no uncertainty.");
  if (!D.mirror) deny("mirrored", "Perspective tells near from far: there is no mirrored answer.");
  $(toggles.model).title ||= "Where the reconstruction would be seen: a cross, joined to its track";
  $(toggles.still).title = "Undo the turning: only the deformation is left";
  $(toggles.mirrored).title ||= "The other answer: near and far swapped";
  $(toggles.spread).title ||= `Ellipsoids of ${scene.SIGMAS} standard deviations` + (D.spread.points.length < N ? `, for ${D.spread.points.length} of the points` : "");
  const cell = scene.cell(), legend = $("shape-legend");
  const unit = D.unit === "u" ? "units" : D.unit;
  for (const [kind, text] of [["seen", "seen"], ["guess", "inferred"]]) {
    const item = make("span");
    item.append(make("i", undefined, "dot " + kind), text);
    legend.append(item);
  }
  if (cell) legend.append(make("span", `ground square ${Number(cell.toPrecision(3))} ${unit}`));
  if (innerWidth > 700) legend.append(make("span", "drag to turn, wheel to zoom"));
}

function recolour() {
  film.recolour();
  scene.recolour();
  charts.recolour();
  refresh();
}

function resize() {
  film.resize();
  scene.resize();
  charts.resize();
  refresh();
}

function draw() {
  film.draw();
  scene.draw();
  charts.draw();
  const scrub = $("scrub");
  scrub.value = S.frame;
  scrub.style.setProperty("--done", (100 * S.frame) / Math.max(1, F - 1) + "%");
  const clock = `${S.frame + 1} / ${F}`, time = `${D.times[S.frame].toFixed(2)}\u202fs`;
  $("clock").textContent = `${time} · ${clock}`;
  scrub.setAttribute("aria-valuetext", `frame ${clock}, ${time}`);
}

let before = 0;
function tick(now) {
  if (now - before > 500) since += now - before; // the page was hidden or busy: go on from where it was
  before = now;
  if (S.playing) advance(now);
  const part = stale;
  stale = NOTHING;
  if (part === ALL) draw();
  else if (part === SHAPE) scene.draw();
  requestAnimationFrame(tick);
}

async function start() {
  await unpack();
  $("scrub").max = F - 1;
  film.open();
  scene.open();
  charts.open();
  words();
  dress();
  $("play").addEventListener("click", () => play(!S.playing));
  $("back").addEventListener("click", () => keys.ArrowLeft());
  $("forth").addEventListener("click", () => keys.ArrowRight());
  $("scrub").addEventListener("input", (event) => seek(Number(event.target.value)));
  $("speed").addEventListener("change", (event) => { S.speed = Number(event.target.value); seek(S.frame); });
  for (const [name, id] of Object.entries(toggles)) $(id).addEventListener("click", () => toggle(name));
  for (const name of Object.keys(scene.PRESETS)) $("view-" + name).addEventListener("click", () => preset(name));
  new ResizeObserver(resize).observe($("film-view"));
  new ResizeObserver(resize).observe($("lanes"));
  dark.addEventListener("change", recolour);
  recolour();
  resize();
  requestAnimationFrame(tick);
  window.torchrecon.loaded = performance.now();
}

// For tests and for curious people: the state, and a way to draw at once.
window.torchrecon = { state: S, data: D, arrays: A, draw, loaded: null };
window.torchrecon.ready = start().catch((error) => { plea(error.message); throw error; });
