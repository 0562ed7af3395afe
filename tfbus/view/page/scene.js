// The picture: the axes, dots and lines of the frames, the robot, points, trails and the measured distance.
//
// It is drawn when something has changed. The robot is drawn first and the frames over it, so that a frame inside of a
// link is seen.

import * as THREE from "./three/three.module.min.js";
import { Dots, Lines } from "./lines.js";

export const STATES = { static: "#0072b2", moving: "#009e73", stale: "#d55e00", lost: "#d0103f", silent: "#767676" };
export const TRAILS = ["#cc79a7", "#56b4e9", "#8c6bb1", "#b3a100", "#7f5539", "#17becf"];
const STATE_TINTS = tints(STATES);
const TRAIL_TINTS = Object.values(tints(TRAILS));
const AXIS_COLOURS = ["#d62728", "#2ca02c", "#1f5fd6"];
const PICK = 14; // In pixels.
const CELLS = 30;

function tints(colours) {
  return Object.fromEntries(Object.entries(colours).map(([name, colour]) => [name, tint(colour)]));
}

// A colour as three numbers that are not converted.
function tint(colour) {
  const number = parseInt(colour.slice(1), 16);
  return [(number >> 16) / 255, ((number >> 8) & 255) / 255, (number & 255) / 255];
}

export class Scene {
  camera = new THREE.PerspectiveCamera(40, 1, 0.01, 1000);
  frames = new THREE.Scene();
  #solids = new THREE.Scene(); // The robot.
  #robot = [];
  #clouds = new Map();
  #edges = new Lines(2);
  #chain = new Lines(7, { under: true });
  #trails = new Lines(2.2);
  #measure = new Lines(2);
  #dots = new Dots();
  #ellipsoid = new THREE.Mesh(
    new THREE.SphereGeometry(1, 32, 16),
    new THREE.MeshBasicMaterial({ color: "#e69f00", transparent: true, opacity: 0.3, depthWrite: false }),
  );
  #axes = null;
  #grid = null;
  #gridColour = "#888888";
  #target = new THREE.Vector3();
  #trailList = [];
  #awake = false;
  #accent = [0, 0, 0];
  #scale = 1; // The length of the axes in m, but for the person's choice.
  axesChoice = 0;
  gridStep = 1;
  beforeDraw = () => {};

  constructor(canvas, state) {
    this.canvas = canvas;
    this.state = state;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.autoClear = false;
    this.camera.up.set(0, 0, 1);
    for (const scene of [this.frames, this.#solids]) {
      scene.add(new THREE.HemisphereLight("#ffffff", "#8d8d99", 2.2));
      const sun = new THREE.DirectionalLight("#ffffff", 1.6);
      sun.position.set(2, -3, 5);
      scene.add(sun);
    }
    this.frames.add(this.#chain, this.#edges, this.#trails, this.#measure, this.#dots, this.#ellipsoid);
    new ResizeObserver(() => this.#resize()).observe(canvas);
    const dark = matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", () => this.#setColours());
    this.#setColours();
    this.#resize();
    state.on("poses frames states selected details hovered choices trails", () => this.wake());
  }

  // Draw soon.
  wake() {
    if (this.#awake) return;
    this.#awake = true;
    requestAnimationFrame(() => {
      this.#awake = false;
      this.#draw();
    });
  }

  position(place) {
    return new THREE.Vector3().fromArray(this.state.poses, 7 * place);
  }

  rotation(place) {
    return new THREE.Quaternion().fromArray(this.state.poses, 7 * place + 3);
  }

  get axesLength() {
    return this.#scale * 2 ** this.axesChoice;
  }

  // The axes and the grid fit a camera that looks at a point from a distance.
  setScale(target, distance) {
    const drawn = this.state.names.filter((_, place) => this.state.drawn(place)).length;
    this.#scale = (0.055 * distance) / (1 + drawn / 150);
    this.gridStep = 10 ** Math.round(Math.log10(distance / 12));
    this.#target.copy(target);
    this.#setGrid();
    this.state.tell("scale");
  }

  // Spheres around all that is drawn: the frames with axes of some length, their trails, and the corners of the robot's shapes.
  extent(axes) {
    const found = [];
    this.#placeRobot();
    this.state.names.forEach((_, place) => {
      if (this.state.drawn(place)) found.push({ centre: this.position(place), radius: axes });
    });
    if (!found.length) return [];
    for (const { points } of this.#trailList) {
      for (let at = 0; at < points.length; at += 30) {
        const centre = new THREE.Vector3().fromArray(points, at);
        if (!Number.isNaN(centre.x)) found.push({ centre, radius: 0 });
      }
    }
    // A frame alone is a point: it is seen from a distance of a few axes.
    if (found.length === 1) found[0].radius = 0.5; // In m.
    for (const { solid } of this.#robot) {
      if (!solid.visible) continue;
      const { min, max } = solid.geometry.boundingBox;
      for (let corner = 0; corner < 8; corner++) {
        const centre = new THREE.Vector3(corner & 1 ? max.x : min.x, corner & 2 ? max.y : min.y, corner & 4 ? max.z : min.z);
        found.push({ centre: centre.applyMatrix4(solid.matrix), radius: 0 });
      }
    }
    return found;
  }

  // The place of the frame at a point of the canvas, in pixels; undefined if there is none.
  pick(x, y) {
    const found = this.nearest(x, y, PICK);
    if (found !== undefined || !this.#robot.length) return found;
    const { clientWidth, clientHeight } = this.canvas;
    const ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2((2 * x) / clientWidth - 1, 1 - (2 * y) / clientHeight), this.camera);
    const hit = ray.intersectObjects(this.#robot.map(({ solid }) => solid).filter((solid) => solid.visible))[0];
    return hit && this.state.index.get(this.#robot.find(({ solid }) => solid === hit.object).link);
  }

  nearest(x, y, reach) {
    let best;
    let least = reach ** 2;
    this.state.names.forEach((_, place) => {
      const at = this.state.drawn(place) && this.onScreen(this.position(place));
      if (!at) return;
      const distance = (at.x - x) ** 2 + (at.y - y) ** 2;
      if (distance < least) [best, least] = [place, distance];
    });
    return best;
  }

  // Where a point is on the canvas, in pixels, and its depth; null if it is behind the camera or outside.
  onScreen(point) {
    const { clientWidth, clientHeight } = this.canvas;
    const seen = point.project(this.camera);
    if (Math.abs(seen.x) > 1 || Math.abs(seen.y) > 1 || Math.abs(seen.z) > 1) return null;
    return { x: ((seen.x + 1) / 2) * clientWidth, y: ((1 - seen.y) / 2) * clientHeight, depth: seen.z };
  }

  setRobot(meshes, solids) {
    for (const { solid } of this.#robot) this.#solids.remove(solid);
    const geometries = meshes.map(({ corners, triangles }) => {
      const indexed = new THREE.BufferGeometry();
      indexed.setAttribute("position", new THREE.BufferAttribute(corners, 3));
      indexed.setIndex(new THREE.BufferAttribute(triangles, 1));
      const geometry = indexed.toNonIndexed();
      geometry.computeVertexNormals();
      geometry.computeBoundingBox();
      return geometry;
    });
    this.#robot = solids.map(({ mesh, link, xyz, xyzw, scale, colour, opacity }) => {
      const material = new THREE.MeshLambertMaterial({ side: THREE.DoubleSide });
      material.color.setRGB(...colour.map((part) => part / 255), THREE.SRGBColorSpace);
      const solid = new THREE.Mesh(geometries[mesh], material);
      solid.matrixAutoUpdate = false;
      solid.visible = false;
      this.#solids.add(solid);
      const below = new THREE.Matrix4().compose(
        new THREE.Vector3(...xyz),
        new THREE.Quaternion(...xyzw),
        new THREE.Vector3(...scale),
      );
      return { link, solid, below, opacity };
    });
    this.setOpacity(this.robotOpacity ?? 0.9);
    this.#placeRobot();
    this.state.tell("robot");
  }

  setOpacity(opacity) {
    this.robotOpacity = opacity;
    for (const { solid, opacity: own } of this.#robot) {
      Object.assign(solid.material, { opacity: opacity * own, transparent: opacity * own < 1, depthWrite: opacity > 0.5 });
      solid.material.needsUpdate = true;
    }
    this.wake();
  }

  setCloud({ name, size, colour }, points, colours) {
    this.#clouds.get(name)?.removeFromParent();
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
    const material = new THREE.PointsMaterial({ size, vertexColors: colours !== null });
    if (colours) geometry.setAttribute("color", new THREE.BufferAttribute(linear(colours), 3));
    else material.color.setRGB(...colour.map((part) => part / 255), THREE.SRGBColorSpace);
    const cloud = new THREE.Points(geometry, material);
    cloud.frustumCulled = false;
    cloud.visible = false;
    this.#clouds.set(name, cloud);
    this.frames.add(cloud);
    this.wake();
  }

  keepClouds(names) {
    for (const [name, cloud] of this.#clouds) {
      if (names.includes(name)) continue;
      cloud.removeFromParent();
      cloud.geometry.dispose();
      this.#clouds.delete(name);
    }
  }

  setTrails(trails) {
    this.#trailList = trails;
    this.wake();
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.#dots.material.uniforms.ratio.value = this.renderer.getPixelRatio();
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.wake();
  }

  #setColours() {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    this.renderer.setClearColor(colour("--sky"));
    this.#accent = tint(colour("--accent"));
    this.#dots.material.uniforms.ring.value.setRGB(...tint(colour("--ring")));
    this.#gridColour = colour("--grid");
    this.#setGrid();
    this.wake();
  }

  #setGrid() {
    this.#grid?.removeFromParent();
    this.#grid?.dispose();
    this.#grid = new THREE.GridHelper(CELLS * this.gridStep, CELLS, this.#gridColour, this.#gridColour);
    this.#grid.rotation.x = Math.PI / 2;
    // On the ground, unless all frames are far from it.
    const { x, y, z } = this.#target;
    const onLine = (place) => Math.round(place / this.gridStep) * this.gridStep;
    this.#grid.position.set(onLine(x), onLine(y), Math.abs(z) > CELLS * this.gridStep ? onLine(z) : 0);
    this.#grid.material.depthWrite = false;
    this.#solids.add(this.#grid);
  }

  #draw() {
    const distance = Math.max(this.camera.position.length(), this.#scale * 20);
    Object.assign(this.camera, { near: this.#scale / 20, far: distance + 500 * this.#scale + 20 * this.gridStep });
    this.camera.updateProjectionMatrix();
    this.camera.updateMatrixWorld();
    this.#placeRobot();
    this.#placeFrames();
    this.beforeDraw();
    this.renderer.clear();
    this.renderer.render(this.#solids, this.camera);
    this.renderer.clearDepth();
    this.renderer.render(this.frames, this.camera);
  }

  #placeFrames() {
    const { state } = this;
    const { poses, parents, states } = state;
    const drawn = state.names.map((_, place) => place).filter((place) => state.drawn(place));
    this.#drawAxes(drawn);
    // Many dots are smaller, so that they do not cover each other.
    const size = 10 / (1 + drawn.length / 800);
    this.#dots.draw(drawn.length, (k, position, colour) => {
      const place = drawn[k];
      position.set(poses.subarray(7 * place, 7 * place + 3));
      colour.set(STATE_TINTS[states[place]]);
      const name = state.names[place];
      return name === state.selected ? 15 : name === state.hovered || name === state.measured ? 13 : size;
    });
    const toParent = (place, begin, finish, colour) => {
      const parent = parents[place];
      if (parent < 0 || !state.drawn(parent)) return false;
      begin.set(poses.subarray(7 * place, 7 * place + 3));
      finish.set(poses.subarray(7 * parent, 7 * parent + 3));
      colour.set(STATE_TINTS[states[place]]);
      return true;
    };
    this.#edges.draw(drawn.length, (k, ...line) => toParent(drawn[k], ...line));
    const { chain } = state;
    this.#chain.draw(Math.max(chain.length - 1, 0), (k, begin, finish, colour) => {
      if (!state.drawn(chain[k]) || !state.drawn(chain[k + 1])) return false;
      begin.set(poses.subarray(7 * chain[k], 7 * chain[k] + 3));
      finish.set(poses.subarray(7 * chain[k + 1], 7 * chain[k + 1] + 3));
      colour.set(this.#accent);
      return true;
    });
    const ends = [state.selected, state.measured].map((name) => state.index.get(name));
    const measured = ends.every((place) => state.hasPose(place));
    this.#measure.draw(measured ? 1 : 0, (_, begin, finish, colour) => {
      begin.set(poses.subarray(7 * ends[0], 7 * ends[0] + 3));
      finish.set(poses.subarray(7 * ends[1], 7 * ends[1] + 3));
      colour.set(this.#accent);
      return true;
    });
    this.#drawTrails();
    this.#drawEllipsoid();
    state.clouds.forEach((name, k) => this.#placeRow(this.#clouds.get(name), state.names.length + k));
  }

  #drawTrails() {
    const pieces = this.#trailList.flatMap(({ frame, points }) => {
      const colour = TRAIL_TINTS[(this.state.trails.get(frame)?.colour ?? 0) % TRAIL_TINTS.length];
      return Array.from({ length: Math.max(points.length / 3 - 1, 0) }, (_, k) => [points, 3 * k, colour]);
    });
    this.#trails.draw(pieces.length, (k, begin, finish, colour) => {
      const [points, at, tint] = pieces[k];
      begin.set(points.subarray(at, at + 3));
      finish.set(points.subarray(at + 3, at + 6));
      colour.set(tint);
      return !Number.isNaN(begin[0] + finish[0]);
    });
  }

  // Two sigma of the position of the selected frame.
  #drawEllipsoid() {
    const { details, selected, ellipsoids, index } = this.state;
    const place = index.get(selected);
    const known = ellipsoids && details.frame === selected && details.ellipsoid && this.state.drawn(place);
    this.#ellipsoid.visible = Boolean(known);
    if (!known) return;
    const [axes, turned] = details.ellipsoid;
    this.#ellipsoid.position.copy(this.position(place));
    this.#ellipsoid.quaternion.set(...turned);
    // A sphere that is flat has no inside.
    this.#ellipsoid.scale.set(...axes.map((axis) => Math.max(axis, 1e-6)));
  }

  #placeRow(object, row) {
    if (!object) return;
    object.visible = this.state.hasPose(row);
    object.position.copy(this.position(row));
    object.quaternion.copy(this.rotation(row));
  }

  #placeRobot() {
    const size = new THREE.Vector3(1, 1, 1);
    for (const { link, solid, below } of this.#robot) {
      const place = this.state.index.get(link);
      solid.visible = this.robotOpacity > 0 && place !== undefined && this.state.drawn(place);
      if (solid.visible) {
        solid.matrix.compose(this.position(place), this.rotation(place), size).multiply(below);
        solid.matrixWorldNeedsUpdate = true;
      }
    }
  }

  #drawAxes(drawn) {
    if (!this.#axes || this.#axes.instanceMatrix.count < drawn.length) {
      this.#axes?.removeFromParent();
      this.#axes?.dispose();
      const material = new THREE.MeshLambertMaterial({ vertexColors: true });
      this.#axes = new THREE.InstancedMesh(axesGeometry(), material, 2 * drawn.length + 16);
      this.#axes.frustumCulled = false;
      this.frames.add(this.#axes);
    }
    const matrix = new THREE.Matrix4();
    const scale = new THREE.Vector3();
    drawn.forEach((place, k) => {
      scale.setScalar(this.axesLength * (this.state.names[place] === this.state.selected ? 1.8 : 1));
      this.#axes.setMatrixAt(k, matrix.compose(this.position(place), this.rotation(place), scale));
    });
    this.#axes.count = drawn.length;
    this.#axes.instanceMatrix.needsUpdate = true;
  }
}

// Three bars of length 1 along x, y and z.
function axesGeometry() {
  const positions = [];
  const normals = [];
  const colours = [];
  AXIS_COLOURS.forEach((colour, axis) => {
    const size = [0.036, 0.036, 0.036];
    size[axis] = 1;
    const offset = [0, 0, 0];
    offset[axis] = 0.5;
    const bar = new THREE.BoxGeometry(...size).translate(...offset).toNonIndexed();
    positions.push(...bar.attributes.position.array);
    normals.push(...bar.attributes.normal.array);
    const { r, g, b } = new THREE.Color(colour);
    for (let corner = 0; corner < bar.attributes.position.count; corner++) colours.push(r, g, b);
  });
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  geometry.setAttribute("normal", new THREE.Float32BufferAttribute(normals, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
  return geometry;
}

function linear(bytes) {
  const colour = new THREE.Color();
  const found = new Float32Array(bytes.length);
  for (let at = 0; at < bytes.length; at += 3) {
    colour.setRGB(bytes[at] / 255, bytes[at + 1] / 255, bytes[at + 2] / 255, THREE.SRGBColorSpace).toArray(found, at);
  }
  return found;
}
