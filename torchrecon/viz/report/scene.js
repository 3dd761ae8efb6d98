// The shape: four views of it in one WebGL canvas. Axes of the data: x right, y down, z away; of the views: y up.

const scene = (() => {
  const canvas = $("shape-canvas"), holder = $("views"), free = $("view-free");
  const views = ["free", "front", "side", "top"].map((name) => $("view-" + name));
  const PRESETS = { front: [0, 0], side: [Math.PI / 2, 0], top: [0, Math.PI / 2] };
  const SIGMAS = 2, STEP = D.steps.points / D.reach;
  let gl = null, programs = {}, buffers = {}, ratio = 1, boxes = [], colours = {}, cell = null;

  const HEAD = `#version 300 es
    precision highp float;
    uniform mat4 projection; uniform mat4 look; uniform mat3 pose;
    vec3 turned(vec3 p) { p = pose * p; return vec3(p.x, -p.y, -p.z); }
    vec4 seen_at(vec3 p) { return projection * (look * vec4(turned(p), 1.0)); }
  `;
  const FRAGMENT = "#version 300 es\nprecision highp float;\nout vec4 o;\n";
  const SOURCES = {
    points: [HEAD + `
      layout(location = 0) in vec4 q;
      uniform float step_, size, deep; uniform int chosen; uniform vec3 near_, mid, far_, guess, pick, ground;
      flat out vec3 colour; flat out float hole, solid, soft;
      void main() {
        vec3 v = turned(q.xyz * step_);
        vec4 eye = look * vec4(v, 1.0);
        gl_Position = projection * eye;
        if (q.w < 2.0) gl_Position = vec4(9.0, 9.0, 9.0, 1.0); // not known: off the screen
        bool seen = mod(q.w, 2.0) > 0.5, mine = chosen == 1;
        float z = clamp(-v.z / deep, -1.0, 1.0);
        colour = z < 0.0 ? mix(mid, near_, -z) : mix(mid, far_, z);
        if (!seen) colour = guess;
        float behind = clamp(0.5 - 0.5 * (eye.z - look[3].z), 0.0, 1.0);
        colour = mix(colour, ground, 0.35 * behind);
        if (mine) colour = pick;
        hole = seen || mine ? 0.0 : 0.5;
        solid = seen || mine ? 1.0 : 0.55;
        gl_PointSize = size * (mine ? 2.0 : seen ? 1.0 : 0.85) * (projection[2][3] < 0.0 ? 5.0 / gl_Position.w : 1.0);
        soft = 2.0 / gl_PointSize; // one pixel
      }`, FRAGMENT + `
      flat in vec3 colour; flat in float hole, solid, soft;
      void main() {
        float r = length(gl_PointCoord * 2.0 - 1.0);
        float a = solid * clamp((1.0 - r) / soft, 0.0, 1.0);
        if (hole > 0.0) a *= clamp((r - hole) / soft + 0.5, 0.0, 1.0);
        if (a < 0.05) discard;
        o = vec4(colour * a, a);
      }`],
    ribbons: [HEAD + `
      layout(location = 0) in vec3 a; layout(location = 1) in vec3 b;
      uniform vec2 screen; uniform float width; out float across;
      void main() {
        vec4 from = seen_at(a), to = seen_at(b);
        vec2 along = (to.xy / to.w - from.xy / from.w) * screen;
        along = along / max(length(along), 1e-6);
        vec4 here = gl_VertexID < 2 ? from : to;
        float side = (gl_VertexID & 1) == 0 ? -1.0 : 1.0;
        across = side * (0.5 * width + 1.0); // pixels from the middle, with room for a soft edge
        here.xy += side * (width + 2.0) * vec2(-along.y, along.x) / screen * here.w;
        gl_Position = here;
      }`, FRAGMENT + `
      in float across; uniform vec4 ink; uniform float width;
      void main() {
        float a = ink.a * clamp(0.5 * width + 0.5 - abs(across), 0.0, 1.0);
        if (a < 0.01) discard;
        o = vec4(ink.rgb * a, a);
      }`],
    ellipsoids: [HEAD + `
      layout(location = 0) in vec3 centre; layout(location = 1) in vec3 r0; layout(location = 2) in vec3 r1;
      uniform float sigmas; out vec2 at; flat out float strength;
      void main() {
        mat3 root = mat3(r0.x, r0.y, r0.z, r0.y, r1.x, r1.y, r0.z, r1.y, r1.z);
        mat3 m = mat3(look) * mat3(turned(root[0]), turned(root[1]), turned(root[2]));
        vec3 row0 = vec3(m[0].x, m[1].x, m[2].x), row1 = vec3(m[0].y, m[1].y, m[2].y);
        float c = dot(row0, row0), d = dot(row0, row1), e = dot(row1, row1);
        float a = sqrt(max(c, 1e-12)), s = d / a, t = sqrt(max(e - s * s, 0.0));
        strength = clamp(0.003 / (a * t + 1e-9), 0.07, 1.0); // the same ink, spread over what it covers
        at = vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID >> 1) * 2 - 1);
        vec4 p = look * vec4(turned(centre), 1.0);
        p.xy += sigmas * vec2(a * at.x, s * at.x + t * at.y);
        gl_Position = projection * p;
      }`, FRAGMENT + `
      in vec2 at; flat in float strength; uniform vec3 ink;
      void main() {
        float r = dot(at, at);
        if (r > 1.0) discard;
        float alpha = strength * mix(0.12, 0.6, pow(r, 5.0));
        o = vec4(ink * alpha, alpha);
      }`],
  };

  function compile([vertex, fragment]) {
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error("The 3D view cannot be set up: " + (gl.getProgramInfoLog(program) || "shader"));
    }
    const places = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      places[name] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  function buffer(content, usage) {
    const made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, content, usage || gl.STATIC_DRAW);
    return made;
  }

  function open() {
    gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) {
      plea("The 3D view needs WebGL 2, which this browser does not offer. Everything else works.");
      return;
    }
    for (const [name, source] of Object.entries(SOURCES)) programs[name] = compile(source);
    // All frames lie on the graphics card; a frame is an offset. Eight bytes a point: x, y, z, flags.
    const all = new Int16Array(4 * F * N);
    for (let i = 0; i < F * N; i++) {
      all.set(A.points.subarray(3 * i, 3 * i + 3), 4 * i);
      all[4 * i + 3] = A.seen[i] + 2 * A.known[i];
    }
    buffers = { points: buffer(all), grid: buffer(grid()), lines: gl.createBuffer(), ellipsoids: gl.createBuffer() };
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.SCISSOR_TEST);
  }

  // Ground under the shape; its cells have a round size, which the legend names.
  function grid() {
    const y = D.floor / D.reach, rough = (2.4 * D.reach) / 10, power = 10 ** Math.floor(Math.log10(rough));
    cell = [1, 2, 5, 10].map((m) => m * power).find((size) => size >= rough);
    const size = cell / D.reach, half = Math.ceil(1.2 / size), end = half * size, lines = [];
    for (let i = -half; i <= half; i++) lines.push(i * size, y, -end, i * size, y, end, -end, y, i * size, end, y, i * size);
    return new Float32Array(lines);
  }

  function recolour() {
    for (const name of ["near", "mid", "far", "guess", "pick", "stage", "ink", "accent"]) colours[name] = rgb(css("--" + name));
  }

  function resize() {
    ratio = Math.min(devicePixelRatio || 1, 2);
    const outer = holder.getBoundingClientRect();
    canvas.width = Math.max(1, Math.round(outer.width * ratio));
    canvas.height = Math.max(1, Math.round(outer.height * ratio));
    boxes = views.map((view) => {
      const box = view.getBoundingClientRect();
      return [box.left - outer.left, outer.bottom - box.bottom, box.width, box.height].map((v) => Math.round(v * ratio));
    });
  }

  // Column-major, as WebGL has it. Positive yaw goes to the side of the larger x, positive pitch goes up.
  function looking(yaw, pitch, distance) {
    const c = Math.cos(yaw), s = Math.sin(yaw), d = Math.cos(pitch), t = Math.sin(pitch);
    return [c, -s * t, s * d, 0, 0, d, t, 0, -s, -c * t, c * d, 0, 0, 0, -distance, 1];
  }

  function projecting(width, height, perspective, zoom) {
    const least = Math.min(width, height), x = (zoom * least) / width, y = (zoom * least) / height;
    if (!perspective) return [x / 1.3, 0, 0, 0, 0, y / 1.3, 0, 0, 0, 0, -0.1, 0, 0, 0, 0, 1];
    const near = 1, far = 40;
    return [3.7 * x, 0, 0, 0, 0, 3.7 * y, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0];
  }

  // Camera axes, or canonical axes with the body held still (transposed rotation); mirrored last.
  function posed(frame) {
    const r = S.still ? D.camera.rotations[frame] : [1, 0, 0, 0, 1, 0, 0, 0, 1], m = S.mirrored ? -1 : 1;
    return [r[0], r[1], m * r[2], r[3], r[4], m * r[5], r[6], r[7], m * r[8]];
  }

  function use(name, uniforms) {
    const { program, places } = programs[name];
    gl.useProgram(program);
    for (const [key, value] of Object.entries(uniforms)) {
      const place = places[key];
      if (place === undefined) continue;
      if (key === "chosen") gl.uniform1i(place, value);
      else if (typeof value === "number") gl.uniform1f(place, value);
      else if (value.length === 2) gl.uniform2fv(place, value);
      else if (value.length === 3) gl.uniform3fv(place, value);
      else if (value.length === 4) gl.uniform4fv(place, value);
      else if (value.length === 9) gl.uniformMatrix3fv(place, false, value);
      else gl.uniformMatrix4fv(place, false, value);
    }
  }

  function attributes(source, layout, each) {
    gl.bindBuffer(gl.ARRAY_BUFFER, source);
    layout.forEach(([size, type, stride, offset], i) => {
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, size, type, false, stride, offset);
      gl.vertexAttribDivisor(i, each);
    });
    for (let i = layout.length; i < 3; i++) gl.disableVertexAttribArray(i);
  }

  function ribbons(common, source, first, count, ink, width, pose) {
    if (!count) return;
    use("ribbons", { ...common, pose, ink, width });
    attributes(source, [[3, gl.FLOAT, 24, 24 * first], [3, gl.FLOAT, 24, 24 * first + 12]], 1);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  }

  const at = (frame, point) => {
    const i = 3 * (frame * N + point);
    return [A.points[i] * STEP, A.points[i + 1] * STEP, A.points[i + 2] * STEP];
  };

  // Bones, then the path of the chosen track, then the three axes.
  function lines(frame) {
    const all = [], known = (f, i) => A.known[f * N + i];
    for (const [a, b] of D.edges) if (known(frame, a) && known(frame, b)) all.push(...at(frame, a), ...at(frame, b));
    const bones = all.length / 6;
    if (S.chosen >= 0) {
      for (let f = Math.max(1, frame - 40); f <= Math.min(F - 1, frame + 40); f++) {
        if (known(f, S.chosen) && known(f - 1, S.chosen)) all.push(...at(f - 1, S.chosen), ...at(f, S.chosen));
      }
    }
    const path = all.length / 6 - bones;
    all.push(0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.lines);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(all), gl.DYNAMIC_DRAW);
    return { bones, path };
  }

  function ellipsoids(frame) {
    const chosen = D.spread.points, out = new Float32Array(9 * chosen.length), step = D.spread.step / D.reach;
    let count = 0;
    chosen.forEach((point, i) => {
      if (!A.known[frame * N + point]) return;
      out.set(at(frame, point), 9 * count);
      for (let k = 0; k < 6; k++) out[9 * count + 3 + k] = A.spread[6 * (frame * chosen.length + i) + k] * step;
      count++;
    });
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.ellipsoids);
    gl.bufferData(gl.ARRAY_BUFFER, out.subarray(0, 9 * count), gl.DYNAMIC_DRAW);
    return count;
  }

  const STILL = [1, 0, 0, 0, 1, 0, 0, 0, 1];

  function draw() {
    if (!gl || gl.isContextLost()) return;
    const frame = S.frame, pose = posed(frame), { bones, path } = lines(frame);
    const uncertain = S.spread && D.spread ? ellipsoids(frame) : 0;
    gl.scissor(0, 0, canvas.width, canvas.height);
    gl.clearColor(...colours.stage, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    views.forEach((view, index) => {
      const [x, y, width, height] = boxes[index];
      if (!width || !height) return;
      gl.viewport(x, y, width, height);
      gl.scissor(x, y, width, height);
      const main = index === 0, [yaw, pitch] = main ? [S.yaw, S.pitch] : PRESETS[view.id.slice(5)];
      const common = {
        projection: projecting(width, height, main, main ? S.zoom : 1), look: looking(yaw, pitch, main ? 5 : 0),
        pose, screen: [width, height],
      };
      gl.enable(gl.DEPTH_TEST);
      gl.depthMask(true);
      if (main) grid_lines(common);
      ribbons(common, buffers.lines, 0, bones, [...colours.ink, 0.45], (main ? 2 : 1.2) * ratio, pose);
      ribbons(common, buffers.lines, bones, path, [...colours.pick, 0.9], (main ? 1.6 : 1) * ratio, pose);
      if (uncertain) {
        gl.depthMask(false);
        use("ellipsoids", { ...common, sigmas: SIGMAS, ink: colours.accent });
        attributes(buffers.ellipsoids, [[3, gl.FLOAT, 36, 0], [3, gl.FLOAT, 36, 12], [3, gl.FLOAT, 36, 24]], 1);
        gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, uncertain);
        gl.depthMask(true);
      }
      const size = (N < 60 ? 10 : N < 400 ? 7 : N < 1500 ? 6 : 4) * ratio * (main ? Math.sqrt(S.zoom) : 0.6);
      const looks = {
        ...common, step_: STEP, deep: D.deep / D.reach, size, near_: colours.near, mid: colours.mid, far_: colours.far,
        guess: colours.guess, pick: colours.pick, ground: colours.stage,
      };
      // A small view has no room for thousands of points: it takes every second, third, ... one.
      const skip = main ? 1 : Math.ceil(N / 1300);
      use("points", { ...looks, chosen: 0 });
      attributes(buffers.points, [[4, gl.SHORT, 8 * skip, 8 * frame * N]], 0);
      gl.drawArrays(gl.POINTS, 0, Math.floor(N / skip));
      if (S.chosen >= 0) {
        gl.disable(gl.DEPTH_TEST);
        use("points", { ...looks, chosen: 1 });
        attributes(buffers.points, [[4, gl.SHORT, 8, 8 * (frame * N + S.chosen)]], 0);
        gl.drawArrays(gl.POINTS, 0, 1);
      }
      if (main) axes(common, bones + path, width, height);
    });
  }

  const grid_lines = (common) => {
    gl.depthMask(false);
    ribbons(common, buffers.grid, 0, grid_count(), [...colours.ink, 0.09], ratio, STILL);
    gl.depthMask(true);
  };
  const grid_count = () => 2 * (2 * Math.ceil(1.2 / (cell / D.reach)) + 1);

  // Small axes in the corner, with words at their ends.
  function axes(common, first, width, height) {
    const long = 30 * ratio, centre = [56 * ratio, 54 * ratio], look = looking(S.yaw, S.pitch, 0);
    const projection = [
      (2 * long) / width, 0, 0, 0, 0, (2 * long) / height, 0, 0, 0, 0, -0.01, 0,
      (2 * centre[0]) / width - 1, (2 * centre[1]) / height - 1, -0.9, 1,
    ];
    gl.disable(gl.DEPTH_TEST);
    ribbons({ ...common, projection, look }, buffers.lines, first, 3, [...colours.ink, 0.55], 1.4 * ratio, STILL);
    ["x", "y", "z"].forEach((name, i) => {
      const v = [i === 0 ? 1 : 0, i === 1 ? -1 : 0, i === 2 ? -1 : 0], away = 1.35 * long;
      const sx = look[0] * v[0] + look[4] * v[1] + look[8] * v[2], sy = look[1] * v[0] + look[5] * v[1] + look[9] * v[2];
      const label = $("axis-" + name);
      label.style.opacity = Math.hypot(sx, sy) < 0.3 ? 0 : 1;
      label.style.transform = `translate(${(centre[0] + away * sx) / ratio}px, ${-(centre[1] + away * sy) / ratio}px) translate(-50%, 50%)`;
    });
  }

  function pick(event) {
    const box = free.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const look = looking(S.yaw, S.pitch, 5), projection = projecting(box.width, box.height, true, S.zoom), pose = posed(S.frame);
    let best = 16, found = -1;
    for (let i = 0; i < N; i++) {
      if (!A.known[S.frame * N + i]) continue;
      const p = at(S.frame, i), v = [0, 1, 2].map((k) => (k ? -1 : 1) * (pose[k] * p[0] + pose[3 + k] * p[1] + pose[6 + k] * p[2]));
      const e = [0, 1, 2].map((k) => look[k] * v[0] + look[4 + k] * v[1] + look[8 + k] * v[2] + look[12 + k]);
      const u = ((projection[0] * e[0]) / -e[2] + 1) * 0.5 * box.width, w = (1 - (projection[5] * e[1]) / -e[2]) * 0.5 * box.height;
      const away = Math.hypot(u - x, w - y);
      if (away < best) { best = away; found = i; }
    }
    choose(found);
  }

  // Drag turns, wheel and pinch zoom, a click chooses.
  const fingers = new Map();
  let moved = 0;
  free.addEventListener("pointerdown", (event) => {
    free.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    moved = 0;
  });
  free.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], other = [...fingers].find(([id]) => id !== event.pointerId);
    if (other) zoom(Math.hypot(now[0] - other[1][0], now[1] - other[1][1]) / Math.max(1, Math.hypot(before[0] - other[1][0], before[1] - other[1][1])));
    else turn((before[0] - now[0]) * 0.008, (now[1] - before[1]) * 0.008);
    moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
    fingers.set(event.pointerId, now);
  });
  for (const kind of ["pointerup", "pointercancel"]) free.addEventListener(kind, (event) => {
    if (kind === "pointerup" && fingers.size === 1 && moved < 4) pick(event);
    fingers.delete(event.pointerId);
  });
  free.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY * 0.0015)); }, { passive: false });
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => { open(); refresh(); });

  function turn(yaw, pitch) {
    S.yaw += yaw;
    S.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, S.pitch + pitch));
    S.preset = null;
    show_view();
    refresh_shape();
  }
  function zoom(factor) {
    S.zoom = Math.max(0.3, Math.min(12, S.zoom * factor));
    refresh_shape();
  }

  return { open, draw, resize, recolour, turn, zoom, PRESETS, SIGMAS, cell: () => cell };
})();
