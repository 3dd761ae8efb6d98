// Timeline, scree plot and bones: drawn once (and again when the size or the colours change), marked every frame.

const charts = (() => {
  const holder = $("lanes");
  // Lines that mark the frame; each lies on its own layer, so that moving it draws no chart again.
  const heads = ["lanes", "bones"].map((name) => ({ part: $(name), line: $(name + "-head"), field: null, left: 0, width: 0 }));
  const readings = [];
  let raster = null, order = [], first_plot = null;

  function path_of(values, top, width, height) {
    let text = "", pen = false;
    values.forEach((value, i) => {
      if (value === null) { pen = false; return; }
      const x = values.length > 1 ? (i / (values.length - 1)) * width : 0, y = height - (Math.min(value, top) / (top || 1)) * height;
      text += (pen ? "L" : "M") + x.toFixed(1) + " " + y.toFixed(2);
      pen = true;
    });
    return text;
  }

  function line(values, top, fill) {
    const W = 1000, H = 100, plot = draw_svg("svg", { viewBox: `0 0 ${W} ${H}`, preserveAspectRatio: "none", "aria-hidden": "true" });
    const d = path_of(values, top, W, H);
    if (fill && !values.includes(null)) plot.append(draw_svg("path", { d: d + `L${W} ${H}L0 ${H}Z`, class: "fill" }));
    plot.append(draw_svg("path", { d, class: "stroke" }));
    return plot;
  }

  const largest = (values) => values.reduce((most, value) => (value !== null && value > most ? value : most), 0);

  // One wild frame must not flatten the rest: the axis ends at the 98th percentile, with room.
  function top_of(values) {
    const sorted = values.filter((value) => value !== null).sort((a, b) => a - b);
    if (!sorted.length) return 1;
    return Math.min(1.25 * largest(values), 1.6 * sorted[Math.floor(0.98 * (sorted.length - 1))]) || largest(values) || 1;
  }

  function lane_row(label, hint, end, plot, name) {
    const row = make("div", undefined, "lane " + name), words = make("div", undefined, "lane-name"), field = make("div", undefined, "plot");
    const value = make("span", "", "value");
    words.append(make("span", label, "label"), value, make("span", end, "end"));
    words.title = hint;
    field.append(plot);
    row.append(words, field);
    holder.append(row);
    first_plot = heads[0].field = first_plot || field;
    return { value, field };
  }

  function timeline() {
    D.lanes.forEach((lane, index) => {
      const top = top_of(lane.values), count = lane.total !== null;
      const { value } = lane_row(lane.label, lane.hint, count ? `of ${lane.total}` : with_unit(top, lane.unit), line(lane.values, top, true), "hue" + (index % 5));
      readings.push(() => {
        const now = lane.values[S.frame];
        reading(holder, value, count ? String(now) : (lane.sigma && now !== null ? "±\u202f" : "") + with_unit(now, lane.unit));
      });
    });
    gaps();
    const ticks = make("div", undefined, "ticks"), scale = make("div", undefined, "plot");
    const total = D.times[F - 1] || 0, rough = total / (innerWidth < 600 ? 4 : 8), power = 10 ** Math.floor(Math.log10(rough || 1));
    const every = [1, 2, 5, 10].map((m) => m * power).find((size) => size >= rough) || 1;
    for (let t = 0; total && t <= total * 1.0001; t += every) {
      const tick = make("span", short(t) + "\u202fs");
      tick.style.left = (100 * t) / total + "%";
      if (t > 0.96 * total) tick.className = "last";
      scale.append(tick);
    }
    ticks.append(make("div", undefined, "lane-name"), scale);
    holder.append(ticks);
  }

  function gaps() {
    raster = make("canvas", undefined, "raster");
    raster.setAttribute("role", "img");
    raster.setAttribute("aria-label", "Which track is seen in which frame: one row a track, filled where it is seen");
    const hint = "One row a track, in the order of their first sight; filled where it is seen.";
    lane_row("Gaps", hint, "", raster, "gaps").value.textContent = N + " rows";
    const born = new Array(N).fill(F), life = new Array(N).fill(0);
    for (let f = F - 1; f >= 0; f--) for (let i = 0; i < N; i++) if (A.seen[f * N + i]) { born[i] = f; life[i]++; }
    order = born.map((_, i) => i).sort((a, b) => born[a] - born[b] || life[b] - life[a]);
  }

  // One pixel a cell, then shrunk once to the size on the screen: the browser would shrink it in every frame.
  function recolour() {
    if (!raster.clientWidth) return;
    const cells = document.createElement("canvas");
    cells.width = F;
    cells.height = N;
    const pen = cells.getContext("2d"), image = pen.createImageData(F, N), seen = rgb(css("--cell")), pick = rgb(css("--pick"));
    order.forEach((point, row) => {
      const ink = point === S.chosen ? pick : seen;
      for (let f = 0; f < F; f++) {
        if (!A.seen[f * N + point]) continue;
        const at = 4 * (row * F + f);
        for (let k = 0; k < 3; k++) image.data[at + k] = 255 * ink[k];
        image.data[at + 3] = 255;
      }
    });
    pen.putImageData(image, 0, 0);
    raster.width = raster.clientWidth * Math.min(devicePixelRatio || 1, 2);
    raster.height = raster.clientHeight * Math.min(devicePixelRatio || 1, 2);
    const ctx = raster.getContext("2d");
    ctx.imageSmoothingEnabled = N > raster.height / 2;
    ctx.imageSmoothingQuality = "high";
    ctx.drawImage(cells, 0, 0, raster.width, raster.height);
    if (S.chosen < 0) return;
    // A chosen row must not vanish between thousands.
    const y = (order.indexOf(S.chosen) * raster.height) / N;
    ctx.imageSmoothingEnabled = false;
    ctx.drawImage(cells, 0, order.indexOf(S.chosen), F, 1, 0, Math.floor(y), raster.width, Math.max(3, raster.height / N));
  }

  function where(event) {
    const box = first_plot.getBoundingClientRect();
    return Math.round(Math.max(0, Math.min(1, (event.clientX - box.left) / box.width)) * (F - 1));
  }
  let held = false;
  holder.addEventListener("pointerdown", (event) => {
    if (!event.target.closest(".plot")) return;
    held = true;
    holder.setPointerCapture(event.pointerId);
    seek(where(event));
    if (event.target === raster) {
      const box = raster.getBoundingClientRect(), row = Math.floor(((event.clientY - box.top) / box.height) * N);
      choose(order[Math.max(0, Math.min(N - 1, row))]);
    }
  });
  holder.addEventListener("pointermove", (event) => { if (held) seek(where(event)); });
  for (const kind of ["pointerup", "pointercancel"]) holder.addEventListener(kind, () => { held = false; });

  function scree() {
    const part = $("scree"), e = D.rank.estimate;
    part.replaceChildren();
    if (!e || e.eigenvalues.length < 2) return;
    const per = e.layout === "vector" ? 6 : 3, shown = Math.min(e.eigenvalues.length, Math.max(per * e.k + 12, 18));
    const W = Math.max(260, part.clientWidth), H = 210, L = 44, B = 34, T = 10, R = 8;
    const values = e.eigenvalues.slice(0, shown), bars = e.threshold.slice(0, shown), positive = [...values, ...bars].filter((v) => v > 0);
    const high = Math.log10(Math.max(...positive)) + 0.15, low = Math.min(high - 1, Math.log10(Math.min(...positive)) - 0.15);
    const x = (i) => L + ((i + 0.5) / shown) * (W - L - R), y = (v) => T + ((high - Math.log10(Math.max(v, 10 ** low))) / (high - low)) * (H - T - B);
    const plot = draw_svg("svg", { viewBox: `0 0 ${W} ${H}`, class: "chart", role: "img", "aria-label": `Eigenvalues of the tracks, largest first; K is ${e.k}` });
    for (let k = 0; k < e.k && (k + 1) * per <= shown; k++) {
      const left = x(k * per - 0.5), width = x((k + 1) * per - 0.5) - left;
      plot.append(draw_svg("rect", { x: left + 1, y: T, width: Math.max(0, width - 2), height: H - T - B, class: "band" }));
    }
    const span = Math.max(1, Math.ceil((high - low) / 5)), small = low >= 0 && high <= 4;
    for (let p = Math.ceil(low); p <= high; p += span) {
      plot.append(draw_svg("line", { x1: L, x2: W - R, y1: y(10 ** p), y2: y(10 ** p), class: "rule" }));
      const label = draw_svg("text", { x: L - 8, y: y(10 ** p) + 4, "text-anchor": "end" }, small ? String(10 ** p) : "10");
      if (!small) label.append(draw_svg("tspan", { dy: -5, "font-size": 9 }, String(p)));
      plot.append(label);
    }
    let steps = "";
    bars.forEach((v, i) => { if (v > 0) steps += (steps ? "L" : "M") + x(i - 0.5) + " " + y(v) + "L" + x(i + 0.5) + " " + y(v); });
    if (steps) plot.append(draw_svg("path", { d: steps, class: "threshold" }));
    values.forEach((v, i) => plot.append(draw_svg("circle", { cx: x(i), cy: y(v), r: 3.6, class: i < per * e.k ? "signal" : "noise" })));
    for (let i = per; i <= shown; i += per * Math.ceil(shown / per / 12)) plot.append(draw_svg("text", { x: x(i - 1), y: H - B + 16, "text-anchor": "middle" }, String(i)));
    plot.append(draw_svg("text", { x: (L + W - R) / 2, y: H - 3, "text-anchor": "middle" }, "eigenvalue, largest first (in units of the noise)"));
    const key = make("p", undefined, "legend");
    for (const [name, text] of [["signal", `counted: ${per} to a basis`], ["noise", "noise"], ...(steps ? [["bar", "threshold"]] : [])]) {
      const item = make("span");
      item.append(make("i", undefined, "dot " + name), text);
      key.append(item);
    }
    part.append(plot, key);
  }

  function bones() {
    const part = $("bones");
    $("bones-part").hidden = !D.bones.length;
    const rows = D.bones.map((bone) => {
      const known = bone.values.filter((value) => value !== null), mean = known.reduce((a, b) => a + b, 0) / (known.length || 1);
      const spread = Math.sqrt(known.reduce((a, b) => a + (b - mean) ** 2, 0) / (known.length || 1));
      return { bone, mean, spread };
    });
    for (const { bone, mean, spread } of rows.sort((a, b) => b.spread / b.mean - a.spread / a.mean)) {
      const row = make("div", undefined, "bone"), field = make("div", undefined, "plot"), now = make("span", "", "value");
      field.append(line(bone.values, Math.max(largest(bone.values), 1.6 * mean), false));
      heads.find((item) => item.part === part).field = field;
      row.append(make("span", bone.name, "label"), field, now, make("span", mean ? `±\u202f${short((100 * spread) / mean)}\u202f%` : "–", "aside"));
      row.lastChild.title = "Standard deviation over the frames, in per cent of the mean length";
      part.append(row);
      readings.push(() => {
        reading(part, now, with_unit(bone.values[S.frame], D.unit));
      });
    }
  }

  function resize() {
    for (const item of heads) {
      if (!item.field) continue;
      item.left = item.field.getBoundingClientRect().left - item.part.getBoundingClientRect().left;
      item.width = item.field.clientWidth;
    }
    recolour();
    scree();
  }

  // Numbers out of sight are not written: each costs a layout.
  const sight = new Map();
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) sight.set(entry.target, entry.isIntersecting);
    refresh();
  });
  function reading(part, node, text) {
    if (sight.get(part) === false || node.textContent === text) return;
    node.textContent = text;
  }

  function draw() {
    for (const { line, left, width } of heads) line.style.transform = `translateX(${left + (width * S.frame) / Math.max(1, F - 1)}px)`;
    for (const read of readings) read();
  }

  function open() {
    timeline();
    bones();
    for (const item of heads) watch.observe(item.part);
  }

  return { open, draw, resize, recolour };
})();
