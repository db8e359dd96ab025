"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const floats = (text) => new Float32Array(bytes(text).buffer);
  function bytes(text) {
    const raw = atob(text), out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
    return out;
  }
  const at = (id) => document.getElementById(id);
  const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
                           a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
  const queries = data.queries, cameraFrusta = floats(data.cameraFrusta);
  const frusta = floats(data.frusta), trueFrusta = floats(data.trueFrusta);
  const inliers = floats(data.inliers), points = floats(data.points);
  const vector = (array, i) => [array[3 * i], array[3 * i + 1], array[3 * i + 2]];
  const centre = (array, i) => vector(array, 5 * i);
  const has = (array, i) => Number.isFinite(array[15 * i]);
  const pointFrames = bytes(data.pointFrames), cameraFrames = bytes(data.cameraFrames);
  const queryFrames = bytes(data.queryFrames);
  let frame = 0, first = 0; // frames have no common coordinates, so one is drawn at a time
  for (const query of queries) { query.first = first; first += query.drawn; }

  // ---- the virtual camera ("eye"): orbits a target; up is the vertical of the map
  const up = data.up;
  const east = unit(cross(Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], up));
  const north = cross(up, east);
  const home = { target: [0, 0, 0], yaw: startYaw(), pitch: 0.5, distance: 1.9 * data.radius };
  let eye = { ...home }, flight = null, chosen = -1;
  function startYaw() {
    // look in the mean viewing direction of the map's cameras
    let sum = [0, 0, 0];
    const n = cameraFrusta.length / 15;
    for (let i = 0; i < n; i++) for (let k = 1; k < 5; k++) sum = add(sum, vector(cameraFrusta, 5 * i + k));
    return Math.hypot(...sum) > 0.2 * n ? yawOf([-sum[0], -sum[1], -sum[2]]) : 0.7;
  }
  function yawOf(d) { return Math.atan2(dot(d, north), dot(d, east)); }
  function backwards(e) { // from the target to the eye
    const c = Math.cos(e.pitch), flat = add([0, 0, 0], east, c * Math.cos(e.yaw));
    return add(add(flat, north, c * Math.sin(e.yaw)), up, Math.sin(e.pitch));
  }
  function axes(e) {
    const back = backwards(e), right = unit(cross(up, back));
    return { back, right, above: cross(back, right), from: add(e.target, back, e.distance) };
  }
  function matrix(e, aspect) {
    const { back, right, above, from } = axes(e), f = 1 / Math.tan(0.45);
    const fx = aspect < 1 ? f : f / aspect, fy = aspect < 1 ? f * aspect : f;
    const near = Math.max(e.distance * 0.005, 1e-5), far = e.distance * 4 + 20 * data.radius;
    const a = -(far + near) / (far - near), b = -2 * far * near / (far - near), m = [];
    for (let k = 0; k < 3; k++) m.push(fx * right[k], fy * above[k], a * back[k], -back[k]);
    m.push(-fx * dot(right, from), -fy * dot(above, from), b - a * dot(back, from), dot(back, from));
    return new Float32Array(m);
  }

  // ---- geometry: points, lines and faces; a vertex is a centre plus a ray of adjustable length
  const canvas = at("scene");
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) trouble("This browser has no WebGL 2, so there is no picture; the list still works.");
  function trouble(text) { at("trouble").textContent = text; at("trouble").hidden = false; }
  const VERTEX = `#version 300 es
    layout(location=0) in vec3 centre; layout(location=1) in vec3 ray; layout(location=2) in vec4 color;
    uniform mat4 view; uniform float size, dot_px; out vec4 tint;
    void main() { gl_Position = view * vec4(centre + size * ray, 1.0);
      gl_PointSize = clamp(dot_px / gl_Position.w, 1.5, 7.0); tint = color; }`;
  const FRAGMENT = `#version 300 es
    precision mediump float; in vec4 tint; out vec4 seen; void main() { seen = tint; }`;
  const program = gl && link();
  function link() {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) trouble(gl.getProgramInfoLog(made) || "no shader");
    return made;
  }
  class Mesh { // rows of centre (3), ray (3), colour (4)
    constructor(kind) { this.kind = kind; this.rows = []; this.count = 0; this.made = null; }
    vertex(c, ray, color, alpha) { this.rows.push(...c, ...ray, ...color, alpha); }
    line(a, b, color, alpha) { this.vertex(a, [0, 0, 0], color, alpha); this.vertex(b, [0, 0, 0], color, alpha); }
    frustum(array, i, color, alpha) {
      const c = centre(array, i), r = [1, 2, 3, 4].map((k) => vector(array, 5 * i + k));
      // two lines above the upper edge, like a roof, show the up direction
      const top = add(add(r[0], r[1]), [0, 0, 0]).map((v, k) => v / 2 + (r[0][k] - r[3][k]) * 0.25);
      for (let k = 0; k < 4; k++) {
        this.vertex(c, [0, 0, 0], color, alpha); this.vertex(c, r[k], color, alpha);
        this.vertex(c, r[k], color, alpha); this.vertex(c, r[(k + 1) % 4], color, alpha);
      }
      for (const k of [0, 1]) { this.vertex(c, r[k], color, alpha); this.vertex(c, top, color, alpha); }
    }
    image(array, i, color, alpha) {
      const c = centre(array, i);
      for (const k of [1, 2, 3, 1, 3, 4]) this.vertex(c, vector(array, 5 * i + k), color, alpha);
    }
    draw(scale = 1) {
      if (this.made === null) {
        this.made = gl.createVertexArray(); gl.bindVertexArray(this.made);
        gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(this.rows), gl.STATIC_DRAW);
        [[0, 3, 0], [1, 3, 12], [2, 4, 24]].forEach(([where, n, from]) => {
          gl.enableVertexAttribArray(where); gl.vertexAttribPointer(where, n, gl.FLOAT, false, 40, from); });
        this.count = this.rows.length / 10; this.rows = [];
      }
      gl.bindVertexArray(this.made);
      gl.uniform1f(uniform.size, scale * size());
      gl.drawArrays(this.kind, 0, this.count);
    }
  }
  const uniform = {};
  if (gl) for (const name of ["view", "size", "dot_px"]) uniform[name] = gl.getUniformLocation(program, name);
  const usual = usualSize();
  function usualSize() { // a part of the median distance to the nearest camera, limited by the size of the scene
    const all = [], array = cameraFrusta.length ? cameraFrusta : trueFrusta.length ? trueFrusta : frusta;
    const n = array.length / 15, step = Math.max(1, Math.floor(n / 200));
    for (let i = 0; i < n; i += step) {
      let best = Infinity;
      for (let j = 0; j < n; j++) if (j !== i) {
        const d = Math.hypot(...add(centre(array, i), centre(array, j), -1));
        if (d > 0 && d < best) best = d;
      }
      if (Number.isFinite(best)) all.push(best);
    }
    const middle = all.sort((a, b) => a - b)[all.length >> 1] || data.radius;
    return Math.min(Math.max(0.35 * middle, 0.018 * data.radius), 0.05 * data.radius);
  }
  const size = () => usual * 2 ** Number(at("size").value);
  const white = [1, 1, 1], red = [1, 0.3, 0.3], grey = [0.56, 0.65, 0.75];
  let dots, cameras, lines, faces, allInliers, own = null; // own: lines and inliers of the chosen query
  function cloud() {
    const mesh = new Mesh(gl.POINTS), colors = bytes(data.colors);
    const rows = new Float32Array(10 * points.length / 3);
    let at = 0;
    for (let i = 0; i < points.length / 3; i++) if (pointFrames[i] === frame) {
      rows.set(points.subarray(3 * i, 3 * i + 3), at);
      for (let k = 0; k < 3; k++) rows[at + 6 + k] = colors[3 * i + k] / 255;
      rows[at + 9] = 1; at += 10;
    }
    mesh.rows = rows.subarray(0, at);
    return mesh;
  }
  function inlierLines(mesh, i, alpha) {
    const q = queries[i];
    for (let k = q.first; k < q.first + q.drawn; k++)
      mesh.line(centre(frusta, i), vector(inliers, k), rgb(q.color), alpha);
  }
  function build() {
    dots = cloud(); own = null;
    [cameras, lines, allInliers] = [0, 1, 2].map(() => new Mesh(gl.LINES));
    faces = new Mesh(gl.TRIANGLES);
    for (let i = 0; i < cameraFrusta.length / 15; i++)
      if (cameraFrames[i] === frame) cameras.frustum(cameraFrusta, i, grey, 0.7);
    queries.forEach((q, i) => {
      if (queryFrames[i] !== frame) return;
      if (has(trueFrusta, i)) lines.frustum(trueFrusta, i, white, 0.55);
      if (!has(frusta, i)) return;
      lines.frustum(frusta, i, rgb(q.color), 1);
      faces.image(frusta, i, rgb(q.color), 0.35);
      if (has(trueFrusta, i)) lines.line(centre(frusta, i), centre(trueFrusta, i), red, 1);
      inlierLines(allInliers, i, 0.12);
    });
  }
  if (gl) build();
  function enter(to) {
    frame = to;
    if (gl) build();
    redraw();
  }
  let asked = false;
  function redraw() { if (!asked) { asked = true; requestAnimationFrame(draw); } }
  function draw(now) {
    asked = false;
    if (flight) fly(now);
    if (!gl) return;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h);
    gl.clearColor(0.063, 0.086, 0.114, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST); gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(program);
    gl.uniformMatrix4fv(uniform.view, false, matrix(eye, w / h));
    const few = Math.min(Math.max(Math.sqrt(6e4 / points.length), 1), 2); // larger dots if there are few points
    gl.uniform1f(uniform.dot_px, 0.006 * few * data.radius * Math.min(w, h));
    const ticked = (id) => { const box = at(id); return box && box.checked; };
    if (ticked("show-points")) dots.draw();
    if (ticked("show-cameras")) cameras.draw();
    lines.draw();
    if (own) own.lines.draw(1.15);
    gl.depthMask(false); // transparent lines and faces do not hide others
    if (ticked("show-inliers")) allInliers.draw();
    if (own) own.inliers.draw();
    faces.draw();
    gl.depthMask(true);
    if (flight) redraw();
  }

  // ---- flying to a query
  const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  function go(to) {
    to.yaw = eye.yaw + Math.atan2(Math.sin(to.yaw - eye.yaw), Math.cos(to.yaw - eye.yaw));
    if (still) { eye = to; flight = null; } else flight = { from: { ...eye }, to, start: performance.now() };
    redraw();
  }
  function fly(now) {
    const t = Math.min(Math.max((now - flight.start) / 700, 0), 1), s = t * t * (3 - 2 * t), { from, to } = flight;
    const mix = (a, b) => a + s * (b - a);
    eye = { target: from.target.map((v, k) => mix(v, to.target[k])), yaw: mix(from.yaw, to.yaw),
            pitch: mix(from.pitch, to.pitch), distance: from.distance * (to.distance / from.distance) ** s };
    if (t === 1) flight = null;
  }
  function choose(i) {
    chosen = i;
    if (queryFrames[i] !== frame) { at("frame").value = queryFrames[i]; enter(queryFrames[i]); }
    const q = queries[i], posed = has(frusta, i), array = posed ? frusta : trueFrusta;
    const said = q.facts.slice();
    if (q.condition) said.unshift(q.condition);
    if (posed && q.drawn) said.push(q.drawn + " inliers drawn");
    if (!has(array, i)) said.push("not drawn: no pose");
    else if (!posed) said.push("the true pose is drawn");
    const name = document.createElement("p");
    name.className = "name"; name.textContent = q.name;
    at("chosen").replaceChildren(name, ...said.map((text) => {
      const line = document.createElement("p");
      line.className = "soft"; line.textContent = text; return line; }));
    for (const button of at("list").querySelectorAll("button"))
      button.setAttribute("aria-current", String(Number(button.dataset.i) === i));
    const item = at("list").querySelector("[aria-current=true]");
    if (item && getComputedStyle(at("list")).overflowY === "auto") item.scrollIntoView({ block: "nearest" });
    if (gl) {
      own = { lines: new Mesh(gl.LINES), inliers: new Mesh(gl.LINES) };
      if (posed) { own.lines.frustum(frusta, i, white, 1); inlierLines(own.inliers, i, 0.3); }
    }
    if (!has(array, i)) { redraw(); return; }
    const c = centre(array, i);
    let ahead = [0, 0, 0];
    for (let k = 1; k < 5; k++) ahead = add(ahead, vector(array, 5 * i + k), 0.25);
    const back = unit(add(ahead.map((v) => -v), up, 0.3 * Math.hypot(...ahead)));
    const apart = posed && has(trueFrusta, i) ? Math.hypot(...add(c, centre(trueFrusta, i), -1)) : 0;
    go({ target: add(c, ahead, size()), yaw: yawOf(back),
         pitch: Math.asin(Math.max(-0.99, Math.min(0.99, dot(back, up)))),
         distance: Math.min(Math.max(9 * size(), 2.5 * apart), 3 * data.radius) });
  }

  // ---- mouse, fingers, keys
  const held = new Map();
  let moved = 0, pinch = null;
  function nearest(x, y, reach) { // nearest frustum, by its centre and the middle of its image
    const m = matrix(eye, canvas.clientWidth / canvas.clientHeight);
    let best = null, least = reach;
    const look = (array, i, kind) => {
      if (!has(array, i) || (kind === "query" ? queryFrames : cameraFrames)[i] !== frame) return;
      const c = centre(array, i);
      let ahead = [0, 0, 0];
      for (let k = 1; k < 5; k++) ahead = add(ahead, vector(array, 5 * i + k), 0.25);
      for (const p of [c, add(c, ahead, size())]) {
        const w = m[3] * p[0] + m[7] * p[1] + m[11] * p[2] + m[15];
        if (w <= 0) continue;
        const px = (0.5 + 0.5 * (m[0] * p[0] + m[4] * p[1] + m[8] * p[2] + m[12]) / w) * canvas.clientWidth;
        const py = (0.5 - 0.5 * (m[1] * p[0] + m[5] * p[1] + m[9] * p[2] + m[13]) / w) * canvas.clientHeight;
        const d = Math.hypot(px - x, py - y);
        if (d < least) { least = d; best = { kind, i }; }
      }
    };
    queries.forEach((_, i) => { look(frusta, i, "query"); look(trueFrusta, i, "query"); });
    if (!best && at("show-cameras").checked) data.cameras.forEach((_, i) => look(cameraFrusta, i, "camera"));
    return best;
  }
  function tip(found, x, y) {
    at("tip").hidden = !found;
    if (!found) return;
    at("tip").textContent = found.kind === "query" ? queries[found.i].name : "map: " + data.cameras[found.i];
    at("tip").style.left = Math.min(x + 12, canvas.clientWidth * 0.6) + "px";
    at("tip").style.top = y + 12 + "px";
  }
  function turn(dx, dy) {
    eye.yaw -= 0.006 * dx;
    eye.pitch = Math.max(-1.5, Math.min(1.5, eye.pitch + 0.006 * dy));
  }
  function shift(dx, dy) {
    const { right, above } = axes(eye), s = 0.97 * eye.distance / Math.min(canvas.clientWidth, canvas.clientHeight);
    eye.target = add(add(eye.target, right, -dx * s), above, dy * s);
  }
  function zoom(factor) {
    eye.distance = Math.max(data.radius * 1e-3, Math.min(data.radius * 50, eye.distance * factor));
  }
  const grip = () => { const [a, b] = [...held.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, d: Math.hypot(a.x - b.x, a.y - b.y) }; };
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    if (!held.size) moved = 0;
    held.set(e.pointerId, { x: e.offsetX, y: e.offsetY });
    pinch = held.size === 2 ? grip() : null;
    flight = null;
  });
  canvas.addEventListener("pointermove", (e) => {
    const last = held.get(e.pointerId);
    if (!last) {
      if (e.pointerType === "mouse") tip(nearest(e.offsetX, e.offsetY, 12), e.offsetX, e.offsetY);
      return;
    }
    const dx = e.offsetX - last.x, dy = e.offsetY - last.y;
    held.set(e.pointerId, { x: e.offsetX, y: e.offsetY });
    moved += Math.abs(dx) + Math.abs(dy);
    if (pinch && held.size === 2) {
      const now = grip();
      shift(now.x - pinch.x, now.y - pinch.y);
      zoom(pinch.d / Math.max(now.d, 1));
      pinch = now;
    } else if (e.buttons & 6 || e.shiftKey || e.ctrlKey) shift(dx, dy); else turn(dx, dy);
    redraw();
  });
  const release = (e) => {
    const known = held.delete(e.pointerId);
    pinch = held.size === 2 ? grip() : null;
    if (!known || e.type !== "pointerup" || held.size || moved > 6) return;
    const found = nearest(e.offsetX, e.offsetY, e.pointerType === "mouse" ? 16 : 28);
    tip(found, e.offsetX, e.offsetY);
    if (found && found.kind === "query") choose(found.i);
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", () => tip(null));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault(); flight = null;
    zoom(Math.exp(Math.max(-1, Math.min(1, e.deltaY * (e.deltaMode ? 0.05 : 0.0015))))); redraw();
  }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const by = { ArrowLeft: [-24, 0], ArrowRight: [24, 0], ArrowUp: [0, -24], ArrowDown: [0, 24] }[e.key];
    if (by) (e.shiftKey ? shift : turn)(...by);
    else if (e.key === "+" || e.key === "-") zoom(e.key === "+" ? 0.8 : 1.25);
    else return;
    e.preventDefault(); flight = null; redraw();
  });
  for (const id of ["show-points", "show-cameras", "show-inliers", "size"])
    if (at(id)) at(id).addEventListener("input", redraw);
  if (at("frame")) at("frame").addEventListener("change", () => enter(Number(at("frame").value)));
  at("home").addEventListener("click", () => go({ ...home }));
  new ResizeObserver(redraw).observe(canvas);

  // ---- the list
  function list() {
    const text = at("filter").value.toLowerCase(), order = at("order").value;
    const key = { rank: (i) => i, inliers: (i) => queries[i].inliers ?? Infinity,
                  confidence: (i) => queries[i].confidence ?? Infinity }[order];
    const shown = queries.map((_, i) => i).filter((i) =>
      (queries[i].name + " " + queries[i].condition).toLowerCase().includes(text));
    shown.sort(key ? (a, b) => key(a) - key(b) || a - b
                   : (a, b) => (queries[a].name < queries[b].name ? -1 : 1));
    at("list").replaceChildren(...shown.map((i) => {
      const q = queries[i], item = document.createElement("li"), button = document.createElement("button");
      const mark = document.createElement("i"), box = document.createElement("span");
      const name = document.createElement("span"), small = document.createElement("small");
      button.type = "button"; button.dataset.i = i;
      button.setAttribute("aria-current", String(i === chosen));
      mark.style.background = q.color; name.className = "name"; name.textContent = q.name;
      small.textContent = q.facts.join(", ");
      box.append(name, small); button.append(mark, box); item.append(button);
      button.addEventListener("click", () => choose(i));
      return item;
    }));
  }
  if (queries.length) {
    at("filter").addEventListener("input", list);
    at("order").addEventListener("change", list);
    list();
    // view.html#query=NAME opens with that query chosen
    const named = /^#query=(.*)$/.exec(location.hash);
    const i = named ? queries.findIndex((q) => q.name === decodeURIComponent(named[1])) : -1;
    if (i >= 0) choose(i);
  }
  redraw();
})();
