// The 3D preview of report.html: Gaussians as opaque elliptic discs, WebGL 2, no library.
// Without WebGL 2 it leaves the page as it is, with a picture in the preview's place.
"use strict";
// Names that look alike are alike, though accents may be characters of their own, as macOS writes them. In large letters
// ß is SS, and any i of Turkish an I.
const plain = (text) => text.toUpperCase().normalize("NFC").replaceAll("\u0130", "I");
for (const field of document.querySelectorAll(".search")) {
  field.hidden = false;
  field.addEventListener("input", () => {
    const wanted = plain(field.value.trim());
    for (const row of document.querySelectorAll(field.dataset.rows)) {
      row.hidden = ![...row.querySelectorAll("bdi")].some((name) => plain(name.textContent).includes(wanted));
    }
    const found = document.querySelectorAll(`${field.dataset.rows}:not([hidden], .elsewhere)`).length;
    field.nextElementSibling.textContent = wanted && `${found} found`;
  });
  // A page that somebody saved while it was in use has the marks of that, here and below.
  field.dispatchEvent(new Event("input"));
}
document.documentElement.classList.remove("js");
(() => {
  const canvas = document.querySelector(".stage canvas");
  const say = (text) => document.querySelector("#preview").insertAdjacentText("beforeend", text);
  // Printed or saved as a picture, a canvas that does not keep what was drawn is black.
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: false, preserveDrawingBuffer: true });
  if (!gl) return say("The preview in 3D needs WebGL 2, which this browser does not offer.");
  const data = JSON.parse(document.getElementById("preview-data").textContent);
  const records = Uint8Array.from(atob(document.getElementById("preview-records").textContent), (c) => c.charCodeAt(0));

  // A pixel belongs to the disc within which a Gaussian's alpha exceeds the threshold; the covariance is projected as
  // 3DGS does it (Kerbl et al. 2023, eq. 5). Camera axes: x right, y up, z forward.
  const VERTEX = `#version 300 es
    precision highp float;
    precision highp sampler2D;
    const float THRESHOLD = 0.18;
    layout(location = 0) in vec2 corner;
    layout(location = 1) in vec3 position;
    layout(location = 2) in uint label;
    layout(location = 3) in vec4 quat;
    layout(location = 4) in vec3 scale;
    layout(location = 5) in float opacity;
    layout(location = 6) in vec3 trueColor;
    layout(location = 7) in float confidence;
    uniform vec3 low, span, eye;
    uniform vec3 core[2];
    uniform float farFrom;
    uniform vec2 logScales, viewport, nearFar;
    uniform mat3 toCamera;
    uniform float focal;
    uniform int mode;
    uniform sampler2D classes, ramp;
    out vec2 place;
    out vec3 color;
    void main() {
      gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
      vec4 ownClass = texelFetch(classes, ivec2(int(label) & 255, int(label) >> 8), 0);
      vec3 world = low + span * position, p = toCamera * (world - eye);
      if (ownClass.a < 0.5 || opacity <= THRESHOLD || p.z < nearFar.x) return;
      // From outside, what is around the scene does not stand before it.
      if (p.z < farFrom && (any(lessThan(world, core[0])) || any(greaterThan(world, core[1])))) return;
      vec4 q = normalize(quat);
      mat3 rotation = mat3(
        1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
        2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
        2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
      vec3 s = exp(mix(vec3(logScales.x), vec3(logScales.y), scale));
      mat3 m = toCamera * rotation * mat3(s.x, 0.0, 0.0, 0.0, s.y, 0.0, 0.0, 0.0, s.z);
      mat3 sigma = m * transpose(m);
      vec2 t = clamp(p.xy / p.z, -1.3 * viewport / (2.0 * focal), 1.3 * viewport / (2.0 * focal));
      vec3 jx = vec3(focal / p.z, 0.0, -focal * t.x / p.z);
      vec3 jy = vec3(0.0, focal / p.z, -focal * t.y / p.z);
      float a = dot(jx, sigma * jx) + 0.3, b = dot(jx, sigma * jy), c = dot(jy, sigma * jy) + 0.3;
      float middle = 0.5 * (a + c), offset = length(vec2(0.5 * (a - c), b));
      vec2 axis = abs(b) > 1e-6 ? normalize(vec2(b, middle + offset - a)) : (a >= c ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
      float reach = sqrt(2.0 * log(opacity / THRESHOLD));
      vec2 radii = min(reach * sqrt(vec2(middle + offset, max(middle - offset, 0.1))), 0.5 * viewport.yy);
      vec2 pixels = corner.x * radii.x * axis + corner.y * radii.y * vec2(-axis.y, axis.x);
      vec2 at = (focal * p.xy / p.z + pixels) / (0.5 * viewport);
      float depth = (nearFar.y + nearFar.x - 2.0 * nearFar.x * nearFar.y / p.z) / (nearFar.y - nearFar.x);
      gl_Position = vec4(at, depth, 1.0);
      place = corner;
      float light = dot(trueColor, vec3(0.3, 0.59, 0.11));
      color = mode == 0 ? mix(vec3(light), ownClass.rgb, 0.68)
            : mode == 1 ? trueColor
            : mix(vec3(light), texture(ramp, vec2(confidence, 0.5)).rgb, 0.85);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec2 place;
    in vec3 color;
    out vec4 pixel;
    void main() {
      float r = length(place);
      if (r > 1.0) discard;
      pixel = vec4(color, clamp((1.0 - r) / max(fwidth(r), 1e-4) + 0.5, 0.0, 1.0));
    }`;

  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);

  const RECORD = 20;  // bytes; gsseg_core/report/preview.py writes them
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, records, gl.STATIC_DRAW);
  const attributes = [
    [1, 3, gl.UNSIGNED_SHORT, 0], [3, 4, gl.BYTE, 8], [4, 3, gl.UNSIGNED_BYTE, 12], [5, 1, gl.UNSIGNED_BYTE, 15],
    [6, 3, gl.UNSIGNED_BYTE, 16], [7, 1, gl.UNSIGNED_BYTE, 19],
  ];
  for (const [location, size, type, offset] of attributes) {
    gl.vertexAttribPointer(location, size, type, true, RECORD, offset);
  }
  gl.vertexAttribIPointer(2, 1, gl.UNSIGNED_SHORT, RECORD, 6);
  for (let location = 1; location <= 7; location++) {
    gl.enableVertexAttribArray(location);
    gl.vertexAttribDivisor(location, 1);
  }

  const sub = (a, b) => a.map((x, i) => x - b[i]);
  const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const plus = (a, t, b) => a.map((x, i) => x + t * b[i]);
  const unit = (a) => a.map((x) => x / (Math.hypot(...a) || 1));

  const span = sub(data.high, data.low), reach = Math.hypot(...span);
  const inner = sub(data.core[1], data.core[0]), extent = Math.hypot(...inner) || 1, middle = plus(data.core[0], 0.5, inner);
  // Farther from the middle than that is outside; no camera that one can look from is.
  const outside = 1.01 * Math.max(extent / 2, ...data.cameras.map((from) => Math.hypot(...sub(from.eye, middle))));
  gl.uniform3fv(uniform("low"), data.low);
  gl.uniform3fv(uniform("span"), span);
  gl.uniform2fv(uniform("logScales"), data.logScales);
  gl.uniform3fv(uniform("core"), data.core.flat());

  // One texel a label that occurs: its colour, and whether it is shown. 256 in a row.
  const rows = Math.ceil(data.labels.length / 256), classes = new Uint8Array(1024 * rows);
  function makeTexture(unitIndex, filter) {
    gl.activeTexture(gl.TEXTURE0 + unitIndex);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  }
  makeTexture(1, gl.LINEAR);
  const RAMP = [[44, 30, 84], [126, 44, 122], [208, 72, 92], [250, 150, 74], [255, 236, 160]];
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, RAMP.length, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(RAMP.flatMap((c) => [...c, 255])));
  makeTexture(0, gl.NEAREST);
  gl.uniform1i(uniform("classes"), 0);
  gl.uniform1i(uniform("ramp"), 1);
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.SAMPLE_ALPHA_TO_COVERAGE);

  // The camera goes round a target; `side` and `ahead` span what is level.
  const up = data.up, side = unit(cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0])), ahead = cross(up, side);
  const camera = { target: [0, 0, 0], distance: 1, yaw: 0, pitch: 0, fov: 0.9 };
  let mode = 0, cut = 0, pending = false;

  function lookFrom(eye, target, fov) {
    const offset = sub(eye, target);
    camera.target = target;
    camera.distance = Math.hypot(...offset);
    camera.pitch = Math.asin(Math.max(-1, Math.min(1, dot(offset, up) / camera.distance)));
    camera.yaw = Math.atan2(dot(offset, ahead), dot(offset, side));
    camera.fov = fov;
    redraw();
  }
  function look(index) {
    const from = data.cameras[index];
    if (from) return lookFrom(from.eye, from.target, from.fov);
    const slope = plus(plus([0, 0, 0], 0.75, up), 0.66, side);
    return lookFrom(plus(middle, 1.1 * extent, slope), middle, 0.7);
  }
  function axes() {
    const level = plus(side.map((x) => x * Math.cos(camera.yaw)), Math.sin(camera.yaw), ahead);
    const back = plus(level.map((x) => x * Math.cos(camera.pitch)), Math.sin(camera.pitch), up);
    const forward = back.map((x) => -x), right = unit(cross(forward, up));
    return { back, forward, right, above: cross(right, forward) };
  }
  function draw() {
    pending = false;
    const scale = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * scale)), height = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    const paper = getComputedStyle(canvas).backgroundColor.match(/[\d.]+/g).slice(0, 3).map((x) => x / 255);
    gl.clearColor(...paper, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { back, forward, right, above } = axes();
    const near = Math.max(extent / 2000, cut * 1.5 * camera.distance);
    const eye = plus(camera.target, camera.distance, back);
    gl.uniform3fv(uniform("eye"), eye);
    gl.uniform1f(uniform("farFrom"), Math.hypot(...sub(eye, middle)) > outside ? camera.distance : 0);
    gl.uniformMatrix3fv(uniform("toCamera"), false, [0, 1, 2].flatMap((i) => [right[i], above[i], forward[i]]));
    // A narrow canvas keeps the width of what is seen, not its height.
    gl.uniform1f(uniform("focal"), Math.min(height, width) / 2 / Math.tan(camera.fov / 2));
    gl.uniform2f(uniform("viewport"), width, height);
    gl.uniform2f(uniform("nearFar"), near, near + 4 * extent + reach + 2 * camera.distance);
    gl.uniform1i(uniform("mode"), mode);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, data.count);
    canvas.dataset.frames = Number(canvas.dataset.frames || 0) + 1;
  }
  function redraw() {
    if (!pending) requestAnimationFrame(draw);
    pending = true;
  }

  const boxes = [...document.querySelectorAll(".legend input")], unobserved = data.removed - 1;
  const levelSlider = document.querySelector(".level"), legend = document.querySelector(".legend");
  const inColumns = legend.classList.contains("many");
  const level = () => levelSlider && data.levels[levelSlider.value];
  function showClasses() {
    const nodes = level()?.nodes, on = new Map(boxes.map((box) => [Number(box.dataset.label), box.checked]));
    data.labels.forEach((number, place) => {
      // What was taken out is drawn as what it covers most: in a colour of its own it would be a stain.
      const label = number < unobserved ? number : number - data.removed;
      const node = label < 0 ? unobserved : nodes ? nodes[label] : label;
      const shown = on.get(number < unobserved ? node : Math.min(number, data.removed)) ?? true;
      classes.set([...data.colors[node], shown ? 255 : 0], 4 * place);
    });
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, classes);
    redraw();
  }
  function showLevel() {
    const { name, shown } = level();
    document.querySelector(".level-name").textContent = name;
    levelSlider.setAttribute("aria-valuetext", name);
    const there = new Set(shown);
    for (const box of boxes) {
      const label = Number(box.dataset.label);
      box.closest("li").classList.toggle("elsewhere", label < unobserved && !there.has(label));
    }
    legend.classList.toggle("many", inColumns && name === "objects");  // Names of parts are long.
    document.querySelector("#preview .search").dispatchEvent(new Event("input"));  // It says how many it finds.
    check(() => true);
  }
  levelSlider?.addEventListener("input", showLevel);
  for (const box of boxes) {
    box.checked = true;
    box.addEventListener("change", showClasses);
  }
  function check(wanted) {
    for (const box of boxes) box.checked = wanted(box);
    showClasses();
  }
  for (const button of document.querySelectorAll(".legend .only")) {
    const own = (box) => box.dataset.label === button.dataset.label;
    button.addEventListener("click", () => check(boxes.every((box) => box.checked === own(box)) ? () => true : own));
  }
  for (const button of document.querySelectorAll("[data-all]")) {
    button.addEventListener("click", () => check(() => button.dataset.all === "1"));
  }

  const modes = [...document.querySelectorAll("[data-mode]")], rampLine = document.querySelector(".ramp");
  for (const button of modes) {
    button.addEventListener("click", () => {
      mode = Number(button.dataset.mode);
      for (const other of modes) other.setAttribute("aria-pressed", other === button);
      rampLine.hidden = mode !== 2;
      redraw();
    });
  }
  const drawing = rampLine.querySelector("canvas").getContext("2d"), gradient = drawing.createLinearGradient(0, 0, 128, 0);
  RAMP.forEach((color, i) => gradient.addColorStop(i / (RAMP.length - 1), `rgb(${color})`));
  drawing.fillStyle = gradient;
  drawing.fillRect(0, 0, 128, 1);

  const looks = document.querySelector(".looks"), slider = document.querySelector(".cut");
  looks.addEventListener("change", () => look(Number(looks.value)));
  slider.addEventListener("input", () => {
    cut = slider.value / 100;
    redraw();
  });

  // Pointers: one turns, two move and zoom.
  const pointers = new Map();
  function turn(dx, dy) {
    camera.yaw -= dx * 0.006;
    camera.pitch = Math.max(-1.55, Math.min(1.55, camera.pitch + dy * 0.006));
    redraw();
  }
  function move(dx, dy) {
    const { right, above } = axes(), step = (2 * camera.distance * Math.tan(camera.fov / 2)) / canvas.clientHeight;
    camera.target = plus(plus(camera.target, -dx * step, right), dy * step, above);
    redraw();
  }
  function zoom(factor) {
    camera.distance = Math.max(extent / 500, Math.min(5 * extent, camera.distance * factor));
    redraw();
  }
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], [dx, dy] = sub(now, before);
    if (pointers.size === 1) {
      (event.shiftKey || event.buttons === 2 ? move : turn)(dx, dy);
    } else {
      const [[, other]] = [...pointers].filter(([id]) => id !== event.pointerId);
      move(dx / 2, dy / 2);
      zoom(Math.hypot(...sub(before, other)) / (Math.hypot(...sub(now, other)) || 1));
    }
    pointers.set(event.pointerId, now);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    // Who scrolls past the preview does not want to be caught by it.
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;  // The browser's own: its zoom, the page before.
    const steer = event.shiftKey ? move : turn;
    const action = {
      ArrowLeft: () => steer(20, 0), ArrowRight: () => steer(-20, 0), ArrowUp: () => steer(0, 20), ArrowDown: () => steer(0, -20),
      "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
    }[event.key];
    if (!action) return;
    event.preventDefault();
    action();
  });

  new ResizeObserver(redraw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  document.documentElement.classList.add("js");
  // A driver that starts anew takes all that was drawn with it.
  canvas.addEventListener("webglcontextlost", () => {
    document.documentElement.classList.remove("js");
    say("The browser has lost the preview in 3D. It is there again when the page is loaded anew.");
  });
  look(0);
  modes[0].click();
  if (levelSlider) showLevel();
  else showClasses();
})();
