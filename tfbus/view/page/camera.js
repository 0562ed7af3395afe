// Where the camera stands: it frames what there is until the person moves it, and can follow a frame.

import * as THREE from "./three/three.module.min.js";
import { OrbitControls } from "./three/OrbitControls.js";

const FROM = new THREE.Vector3(1, -0.9, 0.62).normalize(); // The direction from the frames to the camera.
const MARGIN = 1.15;
const EDGE = 36; // In pixels: the toolbar above and the legend below.
const STRAYS = 200;
const CLOSEST = 0.05; // In m, from the nearest frame.

export class Camera {
  moved = false; // Whether the person has moved it since it framed everything.

  constructor(scene, state, canvas) {
    this.scene = scene;
    this.state = state;
    this.camera = scene.camera;
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("start", () => (this.moved = true));
    this.controls.addEventListener("change", () => scene.wake());
    this.strays = []; // Where frames have left the picture since it was framed.
    this.framed = 0; // The number of frames in the picture that was framed.
    this.trails = 0;
    this.last = null; // Where the followed frame was.
    state.on("poses", () => this.#posesChanged());
    state.on("choices", () => {
      this.last = null;
      this.#follow();
    });
    state.on("robot", () => !this.moved && this.fit());
    state.on("trails", () => {
      if (state.trails.size > this.trails && !this.moved && !state.follow) this.fit(this.strays);
      this.trails = state.trails.size;
    });
    new ResizeObserver(() => !this.moved && this.fit()).observe(canvas);
  }

  // Frame all that is drawn, from the present direction, and where frames have left the picture before.
  fit(strays = []) {
    this.strays = strays;
    // The first time for the length of the axes, the second time with the axes of a selected frame.
    for (const axes of [0, 1.8]) this.#fit([...this.scene.extent(axes * this.scene.axesLength), ...strays]);
    this.moved = false;
    this.scene.wake();
  }

  #fit(points) {
    if (!points.length) return;
    const { camera, controls } = this;
    const back = this.framed ? camera.position.clone().sub(controls.target).normalize() : FROM.clone();
    const right = new THREE.Vector3(0, 0, 1).cross(back).normalize();
    const up = back.clone().cross(right);
    // The distance at which the planes of the view touch the outermost points, whose bounds are x ± z·t and y ± z·t.
    const height = Math.tan(THREE.MathUtils.degToRad(camera.fov / 2)) / MARGIN;
    const free = 1 - (2 * EDGE) / this.scene.canvas.clientHeight;
    const slopes = [height * camera.aspect, height * Math.max(free, 0.5)];
    const depths = points.map(({ centre }) => centre.dot(back));
    const across = [right, up].map((axis) => points.map(({ centre }) => centre.dot(axis)));
    let distance = -Infinity;
    slopes.forEach((slope, k) => {
      let most = -Infinity;
      let least = -Infinity;
      points.forEach(({ radius }, j) => {
        const bound = slope * depths[j] + radius * Math.hypot(1, slope);
        most = Math.max(most, bound + across[k][j]);
        least = Math.max(least, bound - across[k][j]);
      });
      distance = Math.max(distance, (most + least) / (2 * slope));
    });
    distance = Math.max(distance, Math.max(...depths) + CLOSEST);
    const middle = across.map((places) => middleOf(places, depths, distance));
    camera.position.copy(back).multiplyScalar(distance).addScaledVector(right, middle[0]).addScaledVector(up, middle[1]);
    // It turns about the middle of the frames.
    const nearest = Math.max(...points.map(({ centre, radius }) => centre.dot(back) + radius));
    const farthest = Math.min(...points.map(({ centre, radius }) => centre.dot(back) - radius));
    controls.target.copy(camera.position).addScaledVector(back, (nearest + farthest) / 2 - distance);
    controls.update();
    this.scene.setScale(controls.target, camera.position.distanceTo(controls.target));
  }

  #posesChanged() {
    const drawn = this.state.names.map((_, place) => place).filter((place) => this.state.drawn(place));
    if (!this.moved && !this.state.follow) {
      const left = drawn.map((place) => this.scene.position(place)).filter((at) => !this.scene.onScreen(at.clone()));
      if (drawn.length > this.framed) this.fit();
      else if (left.length) this.fit([...this.strays, ...left.map((centre) => ({ centre, radius: 0 }))].slice(-STRAYS));
    }
    this.framed = Math.max(drawn.length, this.framed);
    this.#follow();
  }

  // Move, and turn about the vertical, as the followed frame has since the last picture.
  #follow() {
    const { state, camera, controls } = this;
    const place = state.index.get(state.follow?.frame);
    if (!state.hasPose(place)) return;
    const position = this.scene.position(place);
    const forward = new THREE.Vector3(1, 0, 0).applyQuaternion(this.scene.rotation(place));
    const heading = Math.atan2(forward.y, forward.x);
    if (this.last) {
      const turn = new THREE.Quaternion();
      if (state.follow.heading) turn.setFromAxisAngle(new THREE.Vector3(0, 0, 1), heading - this.last.heading);
      for (const point of [camera.position, controls.target]) {
        point.sub(this.last.position).applyQuaternion(turn).add(position);
      }
      controls.update();
    }
    this.last = { position, heading };
  }
}

// The place of the camera, across its view, from which the outermost points are equally far from the middle.
function middleOf(places, depths, distance) {
  let [low, high] = [Math.min(...places), Math.max(...places)];
  for (let halving = 0; halving < 40; halving++) {
    const middle = (low + high) / 2;
    const seen = places.map((place, j) => (place - middle) / (distance - depths[j]));
    if (Math.max(...seen) + Math.min(...seen) > 0) low = middle;
    else high = middle;
  }
  return (low + high) / 2;
}
