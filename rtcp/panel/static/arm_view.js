// The arm in space: solid links of its URDF, live; a ghost where the motion under way ends, else along a planned path; the
// tool's path of the last seconds; boxes.
import { THREE, OrbitControls } from "nicegui-scene";

const TRACE = 600, TRACE_S = 10, SEEN = "rtcp-camera";
const GHOST = { color: "#2f9e44", opacity: 0.35 }, PARTNER = { color: "#adb5bd" };
const NORMAL = new THREE.Color("#4a6da7"), NEAR = new THREE.Color("#e8590c");

function stored(read) { try { return read(); } catch { return null; } } // a browser may block its storage

function place(object, { xyz, rpy }) {
  object.position.set(...xyz);
  object.rotation.set(rpy[0], rpy[1], rpy[2], "ZYX"); // fixed axes roll, pitch, yaw
}

class Chain {
  constructor(scene, links, style = {}) { // style: a color and opacity of all links
    const { color, opacity = 1 } = style;
    this.joints = [];
    this.links = new Map();
    this.materials = [];
    for (const link of links) {
      const frame = new THREE.Group(), turning = new THREE.Group();
      place(frame, link);
      frame.add(turning);
      (this.links.get(link.parent) ?? scene).add(frame);
      this.links.set(link.name, turning);
      if (link.joint >= 0) this.joints[link.joint] = [turning, new THREE.Vector3(...link.axis)];
      for (const visual of link.visuals) {
        const material = new THREE.MeshPhongMaterial({ color: color ?? (visual.drawn ? "#868e96" : "#4a6da7"),
          transparent: opacity < 1, opacity, depthWrite: style !== GHOST });
        const mesh = new THREE.Mesh(shape(visual), material);
        const holder = new THREE.Group();
        place(holder, visual);
        if (visual.kind === "cylinder") mesh.rotateX(Math.PI / 2);
        holder.add(mesh);
        turning.add(holder);
        if (!visual.drawn) this.materials.push(material);
      }
    }
    this.root = this.links.get(links[0].name).parent;
    this.tool = this.links.get(links[links.length - 1].name);
  }
  set(q) { this.joints.forEach(([turning, axis], at) => turning.setRotationFromAxisAngle(axis, q[at])); }
  toolAt(q) {
    this.set(q);
    this.root.updateWorldMatrix(true, true);
    return this.tool.getWorldPosition(new THREE.Vector3());
  }
}

class Partner { // another arm of the cell, at its base, with its name over it
  constructor(scene, { name, position, rpy, links }) {
    this.name = name;
    this.place = new THREE.Group();
    this.place.position.set(...position);
    this.place.rotation.set(...rpy, "XYZ"); // R = Rx Ry Rz
    this.place.visible = false;
    this.chain = new Chain(this.place, links, PARTNER);
    this.place.add(sign(name));
    scene.add(this.place);
  }
  show(q) {
    this.place.visible = Boolean(q);
    return q && [this.name, this.chain.toolAt(q).toArray().map((value) => +value.toFixed(4))];
  }
}

function sign(text) {
  const canvas = document.createElement("canvas"), brush = canvas.getContext("2d"), font = "bold 40px sans-serif";
  brush.font = font;
  canvas.width = brush.measureText(text).width + 24;
  canvas.height = 56;
  brush.fillStyle = "#343a40";
  brush.fillRect(0, 0, canvas.width, canvas.height);
  brush.font = font;
  brush.fillStyle = "#fff";
  brush.fillText(text, 12, 42);
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map: new THREE.CanvasTexture(canvas) }));
  sprite.scale.set(0.1 * canvas.width / canvas.height, 0.1, 1);
  sprite.position.set(0, 0, -0.08);
  return sprite;
}

function shape({ kind, size }) {
  if (kind === "cylinder") return new THREE.CylinderGeometry(size[0], size[0], size[1], 20);
  if (kind === "sphere") return new THREE.SphereGeometry(size[0], 20, 14);
  return new THREE.BoxGeometry(...size);
}

function line(color, count) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * count), 3));
  geometry.setDrawRange(0, 0);
  const line = new THREE.Line(geometry, new THREE.LineBasicMaterial({ color, depthTest: false }));
  line.renderOrder = 1; // seen through the arm
  line.frustumCulled = false;
  return line;
}

export default {
  template: `<div class="arm-view" role="group" aria-label="The arm in space"><canvas tabindex="0" aria-label="Arrows turn the view, + and - zoom" @keydown="keys"></canvas>
    <p v-if="problem" class="arm-problem">{{ problem }}</p></div>`,
  props: { links: Array, partners: Array },
  data() { return { problem: "" }; },
  mounted() {
    const scene = (this.scene = new THREE.Scene());
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.01, 50);
    this.camera.up.set(0, 0, 1);
    try {
      this.renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true, canvas: this.$el.querySelector("canvas") });
    } catch {
      this.problem = "This browser offers no WebGL: the arm cannot be drawn. Everything else works.";
      return;
    }
    scene.add(new THREE.AmbientLight(0xffffff, 2), Object.assign(new THREE.DirectionalLight(0xffffff, 2)));
    scene.children[1].position.set(3, -4, 6);
    const grid = new THREE.GridHelper(2, 20, "#868e96", "#adb5bd");
    grid.rotateX(Math.PI / 2);
    Object.assign(grid.material, { transparent: true, opacity: 0.5 });
    scene.add(grid, new THREE.AxesHelper(0.2));
    this.arm = new Chain(scene, this.links);
    this.ghost = new Chain(scene, this.links, GHOST);
    this.ghost.root.visible = false;
    this.others = this.partners.map((partner) => new Partner(scene, partner));
    scene.add((this.boxes = new THREE.Group()), (this.rods = new THREE.Group()));
    this.trace = line("#d6336c", TRACE);
    this.path = line("#2f9e44", 400);
    scene.add(this.trace, this.path);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    const kept = stored(() => JSON.parse(sessionStorage.getItem(SEEN))) ?? { at: [-2.2, -2.4, 1.9], to: [0, 0, 0.5] };
    this.camera.position.set(...kept.at);
    this.controls.target.set(...kept.to);
    this.controls.addEventListener("change", () => {
      stored(() => sessionStorage.setItem(SEEN, JSON.stringify({ at: this.camera.position.toArray(), to: this.controls.target.toArray() })));
      this.draw();
    });
    this.controls.update();
    this.renderer.domElement.addEventListener("webglcontextrestored", () => this.draw());
    this.stop = window.rtcp.listen((state) => this.show(state));
    this.sizes = new ResizeObserver(() => this.resize());
    this.sizes.observe(this.$el);
    this.resize();
  },
  beforeUnmount() {
    this.stop?.();
    this.sizes?.disconnect();
    this.renderer?.dispose();
  },
  methods: {
    show(state) {
      if (state.goal && this.plan) { // a motion under way replaces a plan
        this.plan = null;
        if (!state.mine) this.path.geometry.setDrawRange(0, 0);
      }
      if (!this.plan) this.aim(state.goal);
      const places = this.others.map((partner) => partner.show(state.partners?.[partner.name]?.q)).filter(Boolean);
      const around = JSON.stringify(Object.fromEntries(places));
      if (around !== this.$el.dataset.partners) { this.$el.dataset.partners = around; this.draw(); }
      this.drawRod(state.rod ?? []);
      if (!state.joints && this.points?.length) { this.points = []; this.trace.geometry.setDrawRange(0, 0); this.drawBoxes({ box: null, keep_out: {} }); this.draw(); }
      if (!state.joints || !this.$el.clientWidth) return;
      this.arm.set(state.joints.actual_position);
      const before = this.drawn;
      if (state.tool) this.trail(state.tool);
      if (state.singular) {
        const [shoulder, elbow, wrist] = state.singular.map((distance) => distance ?? Infinity);
        const near = 1 - Math.min(1, shoulder / 0.1, elbow / 0.2, wrist / 0.2);
        for (const material of this.arm.materials) material.color.copy(NORMAL).lerp(NEAR, near);
        this.$el.dataset.near = near.toFixed(2);
      }
      if (state.limits) this.drawBoxes(state.limits);
      if (this.plan) this.follow();
      // Draw only on a change: an arm at rest costs its viewers nothing.
      this.drawn = [this.points?.map(([at]) => at), this.$el.dataset.boxes, state.joints.actual_position.map((q) => q.toFixed(4)), state.goal].join();
      if (this.plan || this.drawn !== before) this.draw();
    },
    drawRod(curves) { // the planned curves of the rod along its bend; the last one is the wanted shape
      const drawn = JSON.stringify(curves);
      if (drawn === (this.$el.dataset.rod ?? "[]")) return;
      this.$el.dataset.rod = drawn;
      for (const curve of this.rods.children) { curve.geometry.dispose(); curve.material.dispose(); }
      this.rods.clear();
      curves.forEach((points, at) => {
        const geometry = new THREE.BufferGeometry().setFromPoints(points.map((point) => new THREE.Vector3(...point)));
        const opacity = at + 1 === curves.length ? 1 : 0.35;
        this.rods.add(new THREE.Line(geometry, new THREE.LineBasicMaterial({ color: GHOST.color, transparent: true, opacity })));
      });
      this.draw();
    },
    trail(tool) {
      const now = performance.now() / 1000, points = this.trace.geometry.attributes.position;
      this.points = (this.points ?? []).filter(([at]) => now - at < TRACE_S).slice(1 - TRACE);
      const last = this.points.at(-1)?.[1];
      if (!last || Math.hypot(tool[0] - last[0], tool[1] - last[1], tool[2] - last[2]) > 1e-3) this.points.push([now, tool]);
      this.points.forEach(([, [x, y, z]], at) => points.setXYZ(at, x, y, z));
      points.needsUpdate = true;
      this.trace.geometry.setDrawRange(0, this.points.length);
      this.$el.dataset.trail = this.points.length;
    },
    drawBoxes({ box, keep_out }) {
      const boxes = [...(box ? [[box, false]] : []), ...Object.values(keep_out).map((zone) => [zone, true])];
      const drawn = JSON.stringify(boxes);
      if (drawn === this.$el.dataset.boxes) return;
      this.$el.dataset.boxes = drawn;
      for (const part of this.boxes.children) { part.geometry.dispose(); part.material.dispose(); }
      this.boxes.clear();
      for (const [{ min, max }, isKeptOut] of boxes) {
        const size = max.map((value, at) => value - min[at]), color = isKeptOut ? "#c92a2a" : "#2f9e44";
        const geometry = new THREE.BoxGeometry(...size);
        const solid = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ color, transparent: true,
          opacity: isKeptOut ? 0.2 : 0.03, depthWrite: false }));
        const edges = new THREE.LineSegments(new THREE.EdgesGeometry(geometry), new THREE.LineBasicMaterial({ color }));
        for (const part of [solid, edges]) { part.position.set(...min.map((value, at) => value + size[at] / 2)); this.boxes.add(part); }
      }
    },
    preview(path, duration_s) {
      if (!this.ghost) return;
      this.plan = path?.length ? { path, duration_s: Math.max(0.5, duration_s), began: performance.now() } : null;
      const points = this.path.geometry.attributes.position;
      const drawn = (path ?? []).slice(0, 400);
      drawn.forEach((q, at) => points.array.set(this.ghost.toolAt(q).toArray(), 3 * at));
      points.needsUpdate = true;
      this.path.geometry.setDrawRange(0, drawn.length);
      this.aim(path?.at(-1) ?? window.rtcp.state.goal);
      this.draw();
    },
    aim(q) {
      this.ghost.root.visible = Boolean(q);
      this.$el.dataset.ghost = !q ? "" : this.plan ? "plan" : "goal";
      if (q) this.ghost.set(q);
    },
    follow() {
      const { path, duration_s, began } = this.plan;
      const part = Math.min(1, ((performance.now() - began) / 1000 % (duration_s + 1)) / duration_s);
      this.ghost.set(path[Math.round(part * (path.length - 1))]);
    },
    keys(event) {
      const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      const zoom = { "+": 0.8, "-": 1.25 }[event.key];
      if ((!turn && !zoom) || event.ctrlKey || event.altKey || event.metaKey || !this.controls) return;
      event.preventDefault();
      const seen = this.camera.position.clone().sub(this.controls.target), up = this.camera.up;
      if (zoom) seen.multiplyScalar(zoom);
      else {
        seen.applyAxisAngle(up, turn[0]);
        // Not over the top: the view never turns upside down.
        const polar = seen.angleTo(up), wanted = Math.min(Math.PI - 0.05, Math.max(0.05, polar - turn[1]));
        seen.applyAxisAngle(up.clone().cross(seen).normalize(), wanted - polar);
      }
      this.camera.position.copy(this.controls.target).add(seen);
      this.controls.update();
    },
    draw() { this.renderer?.render(this.scene, this.camera); },
    resize() {
      const { clientWidth, clientHeight } = this.$el;
      if (!clientWidth || !clientHeight) return;
      this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
      this.renderer.setSize(clientWidth, clientHeight, false);
      this.camera.aspect = clientWidth / clientHeight;
      // 54 degrees of the smaller side, so that the boxes fit; a low picture shows the arm, and not all around it.
      const { aspect } = this.camera;
      this.camera.fov = aspect > 2 ? 40 : 2 * THREE.MathUtils.radToDeg(Math.atan(Math.tan(THREE.MathUtils.degToRad(27)) / Math.min(1, aspect)));
      this.camera.updateProjectionMatrix();
      this.draw();
    },
  },
};
