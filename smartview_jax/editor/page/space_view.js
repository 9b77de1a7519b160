// The model in space: wireframe, faces, cameras, and the uncertainty of every point.

import * as THREE from "three";
import { OrbitControls } from "./vendor/OrbitControls.js";

const SIGMAS = 3;
const FIELD_OF_VIEW = 40; // degrees
const PAUSE = 200;       // ms
const MANY_POINTS = 200; // above it, ellipsoids are drawn with fewer triangles

export class SpaceView {
  constructor(owner) {
    this.owner = owner;
    this.element = owner.html(`<div class="sv-view" data-view="3d"><div class="label">3-D <span>drag to turn, wheel to zoom</span></div></div>`);
    try {
      this.renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    } catch {
      this.element.append(owner.html(`<div class="sv-veil">this browser has no WebGL</div>`));
      return;
    }
    this.element.append(this.renderer.domElement);
    this.renderer.setClearColor(0x0f1218);
    this.scene = new THREE.Scene();
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x556070, 2.6));
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 1e-3, 100);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.addEventListener("change", () => this.draw());
    this.parts = new THREE.Group();
    this.cameras = new THREE.Group();
    this.scene.add(this.parts, this.cameras);
    this.sphere = new THREE.SphereGeometry(1, 16, 12);
    this.coarse = new THREE.OctahedronGeometry(1, 1);
    this.framed = "";
    new ResizeObserver(() => this.resize()).observe(this.element);
    this.element.addEventListener("dblclick", () => owner.enlarge(this));
  }

  resize() {
    const box = this.element.getBoundingClientRect();
    if (!this.renderer || !box.width || !box.height) return;
    this.renderer.setPixelRatio(window.devicePixelRatio || 1);
    this.renderer.setSize(box.width, box.height, false);
    this.camera.aspect = box.width / box.height;
    // The field of view is across the shorter side, so that a narrow cell shows the whole object too.
    const half = Math.tan(THREE.MathUtils.degToRad(FIELD_OF_VIEW / 2));
    this.camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(half / Math.min(1, this.camera.aspect)));
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  // Called after an answer. The pictures come first: space is drawn when no answer came for a while.
  update() {
    if (!this.renderer) return;
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => this.rebuild(), PAUSE);
  }

  rebuild() {
    for (const child of [...this.parts.children]) { this.parts.remove(child); if (child.geometry !== this.sphere && child.geometry !== this.coarse) child.geometry.dispose(); }
    const { model, selection } = this.owner;
    const at = (id) => model.points.get(id)?.at;
    const placed = [...model.points].filter(([, point]) => point.at);
    this.frame(placed.map(([, point]) => point.at));
    this.drawCameras();
    const lines = [], colours = [];
    for (const [id, edge] of model.edges) {
      const [a, b] = edge.ends.map(at);
      if (!a || !b) continue;
      lines.push(...a, ...b);
      const colour = new THREE.Color(selection.has(`edges:${id}`) ? 0xffb224 : this.owner.doubts.has(`edges:${id}`) ? 0xff6b5e : 0x6fb3ff);
      colours.push(...colour.toArray(), ...colour.toArray());
    }
    this.addLines(this.parts, lines, colours);
    for (const [id, face] of model.faces) this.addFace(face, face.loop.map(at), selection.has(`faces:${id}`));
    for (const [, grasp] of model.grasps) {
      if (grasp.lines) this.addLines(this.parts, grasp.lines.flat(2), null, 0xffb224);
    }
    this.addAxes(this.owner.symmetry, placed);
    this.addPoints(placed);
    this.draw();
  }

  addLines(group, positions, colours, colour) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
    if (colours) geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
    group.add(new THREE.LineSegments(geometry, new THREE.LineBasicMaterial(colours ? { vertexColors: true } : { color: colour })));
  }

  addFace(face, corners, selected) {
    if (face.problem || corners.some((corner) => !corner)) return;
    // Triangles of a face that need not be convex, cut in its own plane.
    const normal = new THREE.Vector3(...face.normal);
    const x = new THREE.Vector3(...corners[1]).sub(new THREE.Vector3(...corners[0])).normalize();
    const y = new THREE.Vector3().crossVectors(normal, x);
    const flat = corners.map((corner) => { const p = new THREE.Vector3(...corner); return new THREE.Vector2(p.dot(x), p.dot(y)); });
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(corners.flat(), 3));
    geometry.setIndex(THREE.ShapeUtils.triangulateShape(flat, []).flat());
    geometry.computeVertexNormals();
    const colour = selected ? 0xffb224 : face.graspable === true ? 0x58d68d : face.graspable === false ? 0xff6b5e : 0xa78bfa;
    this.parts.add(new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color: colour, transparent: true, opacity: 0.42, side: THREE.DoubleSide, depthWrite: false })));
  }

  // The axes of the symmetry that was found, through its centre and a little beyond the object.
  addAxes(symmetry, placed) {
    if (!symmetry || symmetry.said === false || placed.length < 3) return;
    const centre = new THREE.Vector3(...symmetry.centre);
    const reach = 1.25 * Math.max(...placed.map(([, point]) => centre.distanceTo(new THREE.Vector3(...point.at))));
    const lines = symmetry.axes.flatMap((axis) => [-reach, reach].flatMap((s) => new THREE.Vector3(...axis).multiplyScalar(s).add(centre).toArray()));
    this.addLines(this.parts, lines, null, 0xff5fa8);
  }

  addPoints(placed) {
    if (!placed.length) return;
    // One mesh for all: ellipsoids of three standard deviations, and a dot that is always seen.
    const ellipsoids = new THREE.InstancedMesh(placed.length > MANY_POINTS ? this.coarse : this.sphere, new THREE.MeshLambertMaterial({ color: 0x2fd4bd, transparent: true, opacity: 0.55, depthWrite: false }), placed.length);
    const positions = [], colours = [], matrix = new THREE.Matrix4();
    placed.forEach(([id, point], k) => {
      const [a, b, c] = point.ellipsoid.map((axis) => new THREE.Vector3(...axis).multiplyScalar(SIGMAS));
      matrix.makeBasis(a, b, c).setPosition(...point.at);
      ellipsoids.setMatrixAt(k, matrix);
      positions.push(...point.at);
      const chosen = id === this.owner.active || this.owner.selection.has(`points:${id}`);
      colours.push(...new THREE.Color(chosen ? 0xffb224 : 0x2fd4bd).toArray());
    });
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
    geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
    this.parts.add(ellipsoids, new THREE.Points(geometry, new THREE.PointsMaterial({ size: 5, sizeAttenuation: false, vertexColors: true })));
  }

  drawCameras() {
    if (this.cameras.children.length || !this.owner.model.views.length) return;
    const { views } = this.owner.model, lines = [], depth = 0.12 * this.radius;
    for (const { world_from_camera: rows, size, focal_px: focal } of views) {
      const half = [(depth * size[0]) / focal / 2, (depth * size[1]) / focal / 2];
      const pose = new THREE.Matrix4().set(...rows.flat());
      const centre = new THREE.Vector3().applyMatrix4(pose).toArray();
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([i, j]) => new THREE.Vector3(i * half[0], j * half[1], depth).applyMatrix4(pose).toArray());
      corners.forEach((corner, k) => lines.push(...centre, ...corner, ...corner, ...corners[(k + 1) % 4]));
    }
    this.addLines(this.cameras, lines, null, 0x5b6478);
  }

  // Look at the cameras first, and at the model as soon as there is one; later the person decides.
  frame(points) {
    const views = this.owner.model.views;
    const state = points.length > 3 ? "model" : views.length ? "cameras" : "";
    if (state === this.framed || this.framed === "model") return;
    this.framed = state;
    const centres = views.map((view) => view.world_from_camera.slice(0, 3).map((row) => row[3]));
    const aims = views.map((view) => view.world_from_camera.slice(0, 3).map((row) => row[2]));
    const sphere = new THREE.Box3().setFromPoints(centres.map((p) => new THREE.Vector3(...p))).getBoundingSphere(new THREE.Sphere());
    const mean = new THREE.Vector3();
    for (const aim of aims) mean.add(new THREE.Vector3(...aim));
    mean.normalize();
    const target = points.length ? new THREE.Box3().setFromPoints(points.map((p) => new THREE.Vector3(...p))).getCenter(new THREE.Vector3()) : sphere.center.clone().addScaledVector(mean, 3 * sphere.radius);
    this.radius = Math.max(sphere.center.distanceTo(target), 1e-3);
    const up = Math.abs(mean.z) > 0.5 ? new THREE.Vector3(0, 0, -Math.sign(mean.z)) : new THREE.Vector3(0, -1, 0);
    const aside = new THREE.Vector3().crossVectors(up, mean);
    if (aside.length() < 1e-3) aside.set(1, 0, 0);
    this.camera.up.copy(up);
    const forward = new THREE.Vector3().crossVectors(aside.normalize(), up).negate();
    // From the side and above, so far away that what is to be seen fills the view.
    const extent = points.length ? new THREE.Box3().setFromPoints(points.map((p) => new THREE.Vector3(...p))).getBoundingSphere(new THREE.Sphere()).radius : 0;
    const distance = points.length > 3 ? Math.min(3.9 * extent, 3 * this.radius) : 2.6 * this.radius;
    if (points.length <= 3) target.addScaledVector(up, 0.45 * this.radius);
    const direction = aside.multiplyScalar(0.6).addScaledVector(forward, 0.75).addScaledVector(up, 0.5).normalize();
    this.camera.position.copy(target).addScaledVector(direction, distance);
    this.controls.target.copy(target);
    this.camera.near = this.radius / 1000; this.camera.far = this.radius * 100;
    this.camera.updateProjectionMatrix();
    this.controls.update();
  }

  draw() {
    if (this.renderer) this.renderer.render(this.scene, this.camera);
  }
}
