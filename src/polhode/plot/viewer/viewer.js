// The page of polhode.plot.view: reads the motion from the page, draws it with three.js at the time
// of the slider.
(function () {
"use strict";
const motion = JSON.parse(document.getElementById("motion").textContent);
const byId = (id) => document.getElementById(id);
const COLORS = {
  x: "#ff8a4c", y: "#35d39a", z: "#58a9ff", space: "#b9c4d6", momentum: "#ffd166",
  rate: "#ff6b9d", path: "#58a9ff", ellipsoid: "#9db4d6", herpolhode: "#c9a4ff", plane: "#7f8ca3",
  solid: "#d9dde6",
};
const UP = new THREE.Vector3(0, 1, 0); // direction of the cylinders, cones and grids of three.js

// ---- numbers -------------------------------------------------------------------------------
function decode(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Kind(bytes.buffer);
}
const vector = (array, i) => new THREE.Vector3(array[3 * i], array[3 * i + 1], array[3 * i + 2]);
const turn = (array, i) =>
  new THREE.Quaternion(array[4 * i + 1], array[4 * i + 2], array[4 * i + 3], array[4 * i]);

class Body {
  constructor(about) {
    Object.assign(this, about);
    for (const name of ["ts", "wxyz", "omega_body", "momentum_space"])
      this[name] = decode(about[name], Float32Array);
    this.count = this.ts.length;
  }
  inertia(omega) {
    const m = this.tensor;
    return new THREE.Vector3(
      m[0] * omega.x + m[1] * omega.y + m[2] * omega.z,
      m[3] * omega.x + m[4] * omega.y + m[5] * omega.z,
      m[6] * omega.x + m[7] * omega.y + m[8] * omega.z);
  }
  // Attitude, body rates and momentum at t, interpolated along the shortest rotation between
  // samples, or at the last sample if these are too far apart (`coarse`).
  at(t) {
    let low = 0, high = this.count - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (this.ts[middle] <= t) low = middle; else high = middle;
    }
    if (t >= this.ts[high]) low = high;
    const next = Math.min(low + 1, this.count - 1);
    const gap = this.ts[next] - this.ts[low];
    const part = gap > 0 && !this.coarse ? Math.min(Math.max((t - this.ts[low]) / gap, 0), 1) : 0;
    return {
      index: low,
      attitude: turn(this.wxyz, low).slerp(turn(this.wxyz, next), part),
      omega: vector(this.omega_body, low).lerp(vector(this.omega_body, next), part),
      momentum: vector(this.momentum_space, low).lerp(vector(this.momentum_space, next), part),
    };
  }
}

// ---- pieces --------------------------------------------------------------------------------
const shown = {}; // name of a check box -> the objects that it shows and hides
function keyed(key, object) {
  (shown[key] ??= []).push(object);
  return object;
}

function arrow(color, thickness) {
  const group = new THREE.Group();
  const material = new THREE.MeshStandardMaterial(
    { color, roughness: 0.45, emissive: color, emissiveIntensity: 0.35 });
  const shaft = new THREE.Mesh(new THREE.CylinderGeometry(thickness, thickness, 1, 20), material);
  const head = new THREE.Mesh(new THREE.ConeGeometry(2.6 * thickness, 8 * thickness, 28), material);
  group.add(shaft, head);
  group.point = (direction, length) => {
    const rod = Math.max(length - 8 * thickness, 1e-4);
    shaft.scale.y = rod;
    shaft.position.y = rod / 2;
    head.position.y = rod + 4 * thickness;
    group.quaternion.setFromUnitVectors(UP, direction);
    group.visible = length > 1e-3;
  };
  return group;
}

function label(text, color, size = 0.17) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 96;
  const pen = canvas.getContext("2d");
  pen.font = "600 62px system-ui, sans-serif";
  Object.assign(pen, { textAlign: "center", textBaseline: "middle", lineWidth: 10 });
  pen.strokeStyle = "rgba(15, 19, 27, 0.75)";
  pen.strokeText(text, 48, 50);
  pen.fillStyle = color;
  pen.fillText(text, 48, 50);
  const map = new THREE.CanvasTexture(canvas);
  map.colorSpace = THREE.SRGBColorSpace;
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, depthTest: false }));
  sprite.scale.setScalar(size);
  sprite.renderOrder = 9;
  return sprite;
}

// A curve: all of it faint, and the part before the current time bright.
function curve(points, color, width) {
  const group = new THREE.Group();
  const parts = [[0.28, 0.6 * width], [1, width]].map(([opacity, linewidth]) => {
    const geometry = new THREE.LineGeometry().setPositions(points);
    const line = new THREE.Line2(geometry, new THREE.LineMaterial(
      { color, linewidth, opacity, transparent: true, depthWrite: false }));
    line.renderOrder = 3;
    group.add(line);
    return line;
  });
  const segments = points.length / 3 - 1;
  group.reach = (index) => {
    parts[1].geometry.instanceCount = Math.min(index, segments);
    parts[1].visible = index > 0;
  };
  return group;
}

function axes(names, colors, length, thickness, key, parent) {
  const group = keyed(key, new THREE.Group());
  [[1, 0, 0], [0, 1, 0], [0, 0, 1]].forEach((unit, k) => {
    const direction = new THREE.Vector3(...unit);
    const one = arrow(colors[k], thickness);
    one.point(direction, length);
    const name = label(names[k], colors[k]);
    name.position.copy(direction).multiplyScalar(length + 0.1);
    group.add(one, name);
  });
  parent.add(group);
}

function solid(about) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(decode(about.vertices, Float32Array), 3));
  geometry.setIndex(new THREE.BufferAttribute(decode(about.faces, Uint32Array), 1));
  const coloured = about.colors !== null;
  if (coloured)
    geometry.setAttribute("color", new THREE.BufferAttribute(decode(about.colors, Float32Array), 3));
  const group = keyed("body", new THREE.Group());
  group.add(new THREE.Mesh(geometry, new THREE.MeshStandardMaterial({
    color: coloured ? "#ffffff" : COLORS.solid, vertexColors: coloured, flatShading: true,
    roughness: 0.55, metalness: 0.05, side: THREE.DoubleSide })));
  group.add(new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 28),
    new THREE.LineBasicMaterial({ color: "#11151d", transparent: true, opacity: 0.55 })));
  return group;
}

function lit() {
  const scene = new THREE.Scene();
  scene.add(new THREE.HemisphereLight("#eef4ff", "#2a3242", 1.5));
  const sun = new THREE.DirectionalLight("#fff6e8", 2.4);
  const fill = new THREE.DirectionalLight("#9fc0ff", 0.7);
  scene.add(sun, fill);
  scene.follow = (camera) => { // the lights move with the camera
    sun.position.set(-0.7, 1.1, 1.2).applyQuaternion(camera.quaternion);
    fill.position.set(1.2, -0.4, 0.5).applyQuaternion(camera.quaternion);
  };
  return scene;
}

// ---- the two pictures of a body ---------------------------------------------------------------
function tumbling(body) {
  const scene = lit();
  const carried = new THREE.Group();
  scene.add(carried);
  carried.add(solid(body.solid));
  axes(motion.axis_names, [COLORS.x, COLORS.y, COLORS.z], 1.28, 0.014, "body axes", carried);
  axes(["X", "Y", "Z"], Array(3).fill(COLORS.space), 1.34, 0.006, "space axes", scene);
  const [momentum, rate] = ["angular momentum", "angular velocity"].map(
    (name) => keyed(name, new THREE.Group()));
  const arrows = [arrow(COLORS.momentum, 0.02), arrow(COLORS.rate, 0.02)];
  const names = [label("L", COLORS.momentum), label("ω", COLORS.rate)];
  momentum.add(arrows[0], names[0]);
  scene.add(momentum, rate.add(arrows[1], names[1]));
  const tip = [];
  for (let i = 0; i < body.count; i++)
    tip.push(...new THREE.Vector3(0, 0, 1.28).applyQuaternion(turn(body.wxyz, i)).toArray());
  const path = keyed("path of body " + motion.axis_names[2], curve(tip, COLORS.path, 2));
  scene.add(path);
  const draw = (now) => {
    carried.quaternion.copy(now.attitude);
    const omega = now.omega.clone().applyQuaternion(now.attitude);
    [[now.momentum, body.most_momentum], [omega, body.most_rate]].forEach(([value, most], k) => {
      const length = most > 0 ? 1.6 * value.length() / most : 0;
      const direction = value.clone().normalize();
      arrows[k].point(direction, length);
      names[k].visible = length > 1e-3;
      names[k].position.copy(direction).multiplyScalar(length + 0.1);
    });
    path.reach(now.index);
  };
  return { scene, draw };
}

function rolling(body) {
  const scene = lit();
  const carried = new THREE.Group();
  const size = body.rate_scale;
  const ball = keyed("inertia ellipsoid", new THREE.Group());
  const surface = new THREE.Mesh(new THREE.SphereGeometry(1, 96, 64), new THREE.MeshStandardMaterial(
    { color: COLORS.ellipsoid, roughness: 0.5, transparent: true, opacity: 0.45, depthWrite: false }));
  surface.quaternion.copy(turn(body.principal, 0));
  ball.add(surface);
  carried.add(ball);
  axes(motion.axis_names, [COLORS.x, COLORS.y, COLORS.z], 1.22, 0.01, "body axes", carried);
  const inBody = [], inSpace = [];
  let widest = 0;
  for (let i = 0; i < body.count; i++) {
    const omega = vector(body.omega_body, i).multiplyScalar(size);
    inBody.push(...omega.toArray());
    const normal = body.inertia(omega).normalize();
    widest = Math.max(widest, Math.sqrt(Math.max(omega.lengthSq() - omega.dot(normal) ** 2, 0)));
    inSpace.push(...omega.applyQuaternion(turn(body.wxyz, i)).toArray());
  }
  const polhode = keyed("polhode", curve(inBody, COLORS.rate, 3));
  carried.add(polhode);
  const herpolhode = keyed("herpolhode", curve(inSpace, COLORS.herpolhode, 2.5));
  scene.add(carried, herpolhode);
  const plane = keyed(motion.plane, new THREE.Group());
  const radius = Math.max(1.2 * widest, 0.75);
  const disc = new THREE.Mesh(new THREE.CircleGeometry(radius, 96), new THREE.MeshBasicMaterial(
    { color: COLORS.plane, transparent: true, opacity: 0.14, side: THREE.DoubleSide, depthWrite: false }));
  disc.rotation.x = -Math.PI / 2;
  const grid = new THREE.PolarGridHelper(radius, 12, 4, 96, COLORS.plane, COLORS.plane);
  grid.material.transparent = true;
  grid.material.opacity = 0.4;
  plane.add(disc, grid);
  const rate = keyed("angular velocity", new THREE.Group());
  const pointer = arrow(COLORS.rate, 0.016);
  const contact = new THREE.Mesh(new THREE.SphereGeometry(0.035, 24, 16),
    new THREE.MeshBasicMaterial({ color: "#ffffff" }));
  rate.add(pointer, contact);
  const momentum = keyed("angular momentum", new THREE.Group());
  const upward = arrow(COLORS.momentum, 0.014);
  scene.add(plane, rate, momentum.add(upward));
  const draw = (now) => {
    carried.quaternion.copy(now.attitude);
    const push = body.inertia(now.omega);
    const twice = Math.sqrt(Math.max(now.omega.dot(push), 0)) * size;
    surface.scale.set(...body.semi.map((s) => Math.max(s * twice, 1e-6)));
    polhode.reach(now.index);
    herpolhode.reach(now.index);
    const normal = push.normalize().applyQuaternion(now.attitude);
    const omega = now.omega.clone().multiplyScalar(size).applyQuaternion(now.attitude);
    plane.quaternion.setFromUnitVectors(UP, normal);
    plane.position.copy(normal).multiplyScalar(omega.dot(normal));
    contact.position.copy(omega);
    pointer.point(omega.clone().normalize(), omega.length());
    upward.point(now.momentum.clone().normalize(),
      body.most_momentum > 0 ? 1.4 * now.momentum.length() / body.most_momentum : 0);
  };
  return { scene, draw };
}

// ---- the page ------------------------------------------------------------------------------
function start() {
  const stage = byId("stage"), cells = byId("bodies");
  byId("title").textContent = motion.title;
  byId("note").textContent = motion.note;
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  } catch (error) {
    stage.innerHTML = '<div id="failed">This browser offers no WebGL, which the picture needs.</div>';
    return;
  }
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  renderer.setScissorTest(true);
  stage.prepend(renderer.domElement);

  const camera = new THREE.PerspectiveCamera(30, 1, 0.1, 50);
  camera.up.set(...motion.up);
  camera.position.set(...motion.eye).multiplyScalar(6.9);
  const controls = new THREE.OrbitControls(camera, stage);
  controls.enablePan = false;
  controls.minDistance = 2.5;
  controls.maxDistance = 20;

  const bodies = motion.bodies.map((about) => new Body(about));
  const panes = [];
  for (const body of bodies) {
    const cell = document.createElement("div");
    cell.className = "body";
    const captions = [[tumbling, body.name || "", ""], [rolling, "", motion.rolling]];
    for (const [make, name, words] of captions) {
      const element = document.createElement("div");
      element.className = "pane";
      element.innerHTML = '<div class="caption"><b></b><span class="values"></span></div>';
      element.querySelector("b").textContent = name;
      const values = element.querySelector(".values");
      values.textContent = words;
      cell.append(element);
      panes.push({ ...make(body), body, element, values: make === tumbling ? values : null });
    }
    cells.append(cell);
  }

  const COLOUR_OF = {
    body: COLORS.solid, "body axes": COLORS.x, "space axes": COLORS.space,
    "angular momentum": COLORS.momentum, "angular velocity": COLORS.rate,
    "inertia ellipsoid": COLORS.ellipsoid, polhode: COLORS.rate, herpolhode: COLORS.herpolhode,
    [motion.plane]: COLORS.plane,
  };
  for (const [name, objects] of Object.entries(shown)) {
    const line = document.createElement("label");
    line.innerHTML = '<input type="checkbox"><span></span>';
    line.style.setProperty("--key", COLOUR_OF[name] ?? COLORS.path);
    line.querySelector("span").textContent = name;
    const box = line.querySelector("input");
    box.checked = !motion.hidden.includes(name);
    const set = () => objects.forEach((one) => { one.visible = box.checked; });
    box.addEventListener("change", () => { set(); requestDraw(); });
    byId("keys").append(line);
    set();
  }

  // ---- time ----
  const unit = motion.unit, last = motion.duration;
  const digits = Math.max(0, Math.min(6, 3 - Math.floor(Math.log10(last / unit.seconds || 1))));
  const slider = byId("time"), play = byId("play"), speed = byId("speed");
  slider.max = last;
  for (const factor of [0.1, 0.25, 0.5, 1, 2, 4, 10])
    speed.add(new Option(factor + " ×", factor, factor === 1, factor === 1));
  let now = 0, playing = false, before = null, isRequested = false;
  const ICONS = {
    true: '<svg width="14" height="14"><rect x="1" width="4" height="14"/><rect x="9" width="4" height="14"/></svg>',
    false: '<svg width="14" height="14"><path d="M3 0 L14 7 L3 14 Z"/></svg>',
  };
  const setPlaying = (value) => {
    playing = value;
    before = null;
    play.innerHTML = ICONS[playing];
    play.title = playing ? "pause" : "play";
    requestDraw();
  };
  play.addEventListener("click", () => {
    if (!playing && now >= last) now = 0;
    setPlaying(!playing);
  });
  slider.addEventListener("input", () => { now = Number(slider.value); setPlaying(false); });
  window.addEventListener("keydown", (event) => {
    if (event.key === " " && event.target === document.body) play.click();
  });
  controls.addEventListener("change", () => requestDraw());
  // page.html#t=12.5 opens at the time 12.5, in the time unit of the page
  const fromAddress = () => {
    const found = /[#&]t=([-+.\deE]+)/.exec(location.hash);
    if (!found) return false;
    now = Math.min(Math.max(Number(found[1]) * unit.seconds - motion.start, 0), last) || 0;
    setPlaying(false);
    return true;
  };
  window.addEventListener("hashchange", fromAddress);

  function layout() {
    const width = stage.clientWidth, height = stage.clientHeight, count = bodies.length;
    let best = null;
    for (let columns = 1; columns <= count; columns++) {
      const rows = Math.ceil(count / columns), w = width / columns, h = height / rows;
      for (const tall of [false, true]) {
        const side = Math.min(tall ? w : w / 2, tall ? h / 2 : h);
        // of layouts of similar size, prefer the one with more columns
        if (!best || side > 0.93 * best.side) best = { side: Math.max(side, best?.side ?? 0), columns, tall };
      }
    }
    cells.style.gridTemplateColumns = `repeat(${best.columns}, minmax(0, 1fr))`;
    cells.style.gridAutoRows = "minmax(0, 1fr)";
    for (const cell of cells.children) cell.classList.toggle("tall", best.tall);
    renderer.setSize(width, height);
    requestDraw();
  }

  function draw() {
    slider.value = now;
    byId("readout").textContent =
      `t = ${((motion.start + now) / unit.seconds).toFixed(digits)} ${unit.time}`;
    const frame = stage.getBoundingClientRect();
    for (const pane of panes) {
      const at = pane.body.at(now);
      pane.draw(at);
      if (pane.values)
        pane.values.textContent = `|ω| ${(at.omega.length() / unit.rate_size).toPrecision(4)} ${unit.rate}`;
      const box = pane.element.getBoundingClientRect();
      const aspect = box.width / box.height;
      camera.aspect = aspect;
      const half = Math.tan(Math.PI / 12); // so that the unit ball fits into the narrower side
      camera.fov = 2 * Math.atan(aspect >= 1 ? half : half / aspect) * 180 / Math.PI;
      camera.updateProjectionMatrix();
      pane.scene.follow(camera);
      const left = box.left - frame.left, bottom = frame.bottom - box.bottom;
      renderer.setViewport(left, bottom, box.width, box.height);
      renderer.setScissor(left, bottom, box.width, box.height);
      renderer.render(pane.scene, camera);
    }
  }

  function requestDraw() {
    if (!isRequested) {
      isRequested = true;
      requestAnimationFrame(step);
    }
  }
  function step(clock) {
    isRequested = false;
    if (playing) {
      if (before !== null) now += (clock - before) / 1000 * motion.pace * Number(speed.value);
      before = clock;
      if (now > last) now %= last;
    }
    draw();
    if (playing) requestDraw();
  }

  new ResizeObserver(layout).observe(stage);
  layout();
  const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (!fromAddress()) setPlaying(!still);
}
start();
})();
