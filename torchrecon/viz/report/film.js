// The film with the tracks on it, on a 2D canvas; pictures are decoded a little ahead and forgotten behind.

const film = (() => {
  const canvas = $("film-canvas"), ctx = canvas.getContext("2d"), view = $("film-view");
  const AHEAD = 12, KEEP = 40, SHADES = 11;
  const pictures = new Map(), starts = [];
  const dots = document.createElement("canvas");
  let fit = { x: 0, y: 0, scale: 1, ratio: 1 }, shown = null, shades = [], radius = 3, side = 8;
  const [tall, wide] = D.size;

  function open() {
    if (!D.film) return;
    let at = 0;
    for (const size of D.film.sizes) { starts.push(at); at += size; }
  }

  function request(index) {
    if (pictures.has(index) || index >= starts.length) return;
    pictures.set(index, null);
    const end = starts[index] + D.film.sizes[index];
    createImageBitmap(new Blob([A.film.subarray(starts[index], end)], { type: "image/jpeg" })).then(
      (bitmap) => { pictures.set(index, bitmap); if (index === wanted()) refresh(); },
      () => plea("One picture of the film cannot be decoded; the file may be damaged."),
    );
  }

  const wanted = () => Math.min(Math.floor(S.frame / D.film.every), starts.length - 1);

  function picture() {
    const now = wanted();
    for (let i = now; i <= now + AHEAD; i++) request(i);
    if (pictures.size > KEEP) {
      for (const [index, bitmap] of pictures) {
        if (pictures.size <= KEEP) break;
        if (index >= now - 4 && index <= now + AHEAD) continue;
        if (bitmap && bitmap !== shown) bitmap.close();
        if (bitmap !== shown) pictures.delete(index);
      }
    }
    shown = pictures.get(now) || shown;
    return shown;
  }

  function recolour() {
    const ramp = ["--near", "--mid", "--far"].map((name) => rgb(css(D.film ? name + "-film" : name)));
    shades = Array.from({ length: SHADES }, (_, i) => {
      const t = (2 * i) / (SHADES - 1), [from, to] = t < 1 ? [ramp[0], ramp[1]] : [ramp[1], ramp[2]], s = t < 1 ? t : t - 1;
      return "rgb(" + from.map((v, k) => Math.round(255 * (v + s * (to[k] - v)))).join(" ") + ")";
    });
    stamp();
  }

  function resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2), box = view.getBoundingClientRect();
    canvas.width = Math.max(1, Math.round(box.width * ratio));
    canvas.height = Math.max(1, Math.round(box.height * ratio));
    const scale = Math.min(canvas.width / wide, canvas.height / tall);
    fit = { scale, x: (canvas.width - wide * scale) / 2, y: (canvas.height - tall * scale) / 2, ratio };
    stamp();
  }

  const px = (x) => fit.x + (x - D.corner[0]) * fit.scale;
  const py = (y) => fit.y + (y - D.corner[1]) * fit.scale;

  // Where the reconstruction would be seen.
  function model(f, i) {
    const at = 3 * (f * N + i), step = D.steps.points, s = D.camera.scale[f], t = D.camera.translation[f], k = D.camera.intrinsics;
    const x = A.points[at] * step * s + t[0], y = A.points[at + 1] * step * s + t[1];
    if (!k) return [x, y];
    const z = A.points[at + 2] * step * s + t[2];
    return [(k[0][0] * x + k[0][1] * y) / z + k[0][2], (k[1][1] * y) / z + k[1][2]];
  }

  function place(f, i) {
    const at = f * N + i;
    if (A.seen[at] || !D.tracked) return [A.xy[2 * at] * D.steps.xy, A.xy[2 * at + 1] * D.steps.xy];
    return model(f, i);
  }

  function shade(f, i) {
    const z = (A.points[3 * (f * N + i) + 2] * D.steps.points * (S.mirrored ? -1 : 1)) / D.deep;
    return Math.max(0, Math.min(SHADES - 1, Math.round(((z + 1) / 2) * (SHADES - 1))));
  }

  function trails(f) {
    const from = Math.max(0, f - Math.max(2, Math.min(12, Math.floor(5000 / N))));
    ctx.beginPath();
    for (let i = 0; i < N; i++) {
      if (!A.seen[f * N + i]) continue;
      let pen = false;
      for (let g = f; g >= from && A.seen[g * N + i]; g--) {
        const at = 2 * (g * N + i), x = px(A.xy[at] * D.steps.xy), y = py(A.xy[at + 1] * D.steps.xy);
        if (pen) ctx.lineTo(x, y); else ctx.moveTo(x, y);
        pen = true;
      }
    }
    ctx.lineWidth = 1.1 * fit.ratio;
    ctx.strokeStyle = D.film ? "rgb(255 255 255 / .6)" : css("--faint");
    ctx.stroke();
  }

  // One picture of a dot for each shade and one of a ring, drawn once: copying them is faster than filling circles.
  function stamp() {
    radius = (N < 60 ? 4 : N < 400 ? 3 : N < 1500 ? 2.2 : 1.6) * fit.ratio;
    side = 2 * Math.ceil(radius + fit.ratio + 1);
    dots.width = side * (SHADES + 1);
    dots.height = side;
    const pen = dots.getContext("2d");
    for (let i = 0; i <= SHADES; i++) {
      const ring = i === SHADES, x = side * (i + 0.5), y = side / 2;
      if (D.film && !ring) {
        pen.beginPath();
        pen.arc(x, y, radius + fit.ratio, 0, 7);
        pen.fillStyle = "rgb(0 0 0 / .5)";
        pen.fill();
      }
      pen.beginPath();
      pen.arc(x, y, radius, 0, 7);
      pen.lineWidth = fit.ratio;
      pen.strokeStyle = D.film ? "rgb(255 255 255 / .7)" : css("--faint");
      pen.fillStyle = shades[i];
      if (ring) pen.stroke(); else pen.fill();
    }
  }

  function marks(f) {
    for (let i = 0; i < N; i++) {
      const at = f * N + i, seen = A.seen[at];
      if (!seen && !(A.known[at] && (S.model || !D.tracked))) continue;
      const [x, y] = place(f, i), kind = !seen ? SHADES : A.known[at] ? shade(f, i) : SHADES >> 1;
      ctx.drawImage(dots, side * kind, 0, side, side, Math.round(px(x) - side / 2), Math.round(py(y) - side / 2), side, side);
    }
  }

  function bones(f) {
    ctx.beginPath();
    for (const [a, b] of D.edges) {
      if (!A.known[f * N + a] || !A.known[f * N + b]) continue;
      const [ax, ay] = place(f, a), [bx, by] = place(f, b);
      ctx.moveTo(px(ax), py(ay)); ctx.lineTo(px(bx), py(by));
    }
    ctx.lineWidth = 2 * fit.ratio;
    ctx.strokeStyle = D.film ? "rgb(255 255 255 / .75)" : css("--faint");
    ctx.stroke();
  }

  function misfits(f) {
    const cross = 2.5 * fit.ratio;
    ctx.beginPath();
    for (let i = 0; i < N; i++) {
      if (!A.seen[f * N + i] || !A.known[f * N + i]) continue;
      const [tx, ty] = place(f, i), [mx, my] = model(f, i), x = px(mx), y = py(my);
      ctx.moveTo(px(tx), py(ty)); ctx.lineTo(x, y);
      ctx.moveTo(x - cross, y); ctx.lineTo(x + cross, y); ctx.moveTo(x, y - cross); ctx.lineTo(x, y + cross);
    }
    ctx.lineWidth = 1.2 * fit.ratio;
    ctx.strokeStyle = css(D.film ? "--accent-film" : "--accent");
    ctx.stroke();
  }

  function draw() {
    ctx.clearRect(0, 0, canvas.width, canvas.height);
    const f = S.frame;
    if (D.film) {
      const bitmap = picture();
      if (bitmap) ctx.drawImage(bitmap, fit.x, fit.y, wide * fit.scale, tall * fit.scale);
    } else {
      ctx.strokeStyle = css("--line");
      ctx.lineWidth = fit.ratio;
      ctx.strokeRect(fit.x + 0.5, fit.y + 0.5, wide * fit.scale - 1, tall * fit.scale - 1);
    }
    ctx.save();
    ctx.beginPath();
    ctx.rect(fit.x, fit.y, wide * fit.scale, tall * fit.scale);
    ctx.clip();
    if (S.trails && D.tracked) trails(f);
    if (S.tracks && D.edges.length) bones(f);
    if (S.tracks) marks(f);
    if (S.model && D.tracked) misfits(f);
    if (S.chosen >= 0 && A.known[f * N + S.chosen] | A.seen[f * N + S.chosen]) {
      const [x, y] = place(f, S.chosen);
      ctx.beginPath();
      ctx.arc(px(x), py(y), 8 * fit.ratio, 0, 7);
      ctx.lineWidth = 2.5 * fit.ratio;
      ctx.strokeStyle = css(D.film ? "--pick-film" : "--pick");
      ctx.stroke();
    }
    ctx.restore();
  }

  function pick(event) {
    const box = canvas.getBoundingClientRect(), x = (event.clientX - box.left) * fit.ratio, y = (event.clientY - box.top) * fit.ratio;
    let best = 18 * fit.ratio, found = -1;
    for (let i = 0; i < N; i++) {
      const at = S.frame * N + i;
      if (!A.seen[at] && !A.known[at]) continue;
      const [u, v] = place(S.frame, i), away = Math.hypot(px(u) - x, py(v) - y);
      if (away < best) { best = away; found = i; }
    }
    choose(found);
  }
  canvas.addEventListener("click", pick);

  return { open, draw, resize, recolour };
})();
