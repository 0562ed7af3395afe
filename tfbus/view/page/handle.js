// The handle of a frame that may be moved by hand: drag it, type numbers, go by steps, undo, save.
//
// A pose here is that of the frame in its parent, in doubles from the server: {xyz, xyzw}. A drag is a motion of the
// handle by some D in its own axes; the new pose is the old one times D, turned into the frame's axes, so that the
// rounded numbers of the picture never reach the pose.

import * as THREE from "./three/three.module.min.js";
import { TransformControls } from "./three/TransformControls.js";

const QUIET = 700; // In ms: after an own edit, an older pose from the server may still come.
const FIELDS = ["x", "y", "z", "roll", "pitch", "yaw"];

export class Handle {
  #proxy = new THREE.Object3D();
  #controls;
  #grabbed = null; // The pose and the handle when the drag began.
  #pose = null;
  #editedAt = -Infinity;
  #undo = []; // {frame, xyz, xyzw}
  #axes = "local";

  constructor(state, scene, camera, connection) {
    Object.assign(this, { state, scene, connection });
    this.section = document.getElementById("edit");
    this.undoButton = document.getElementById("undo");
    const controls = (this.#controls = new TransformControls(scene.camera, scene.canvas));
    controls.setSpace("local"); // The handle itself is turned to the axes that are wanted.
    controls.addEventListener("dragging-changed", ({ value }) => {
      camera.controls.enabled = !value;
      value ? this.#grab() : this.#release();
    });
    controls.addEventListener("objectChange", () => this.#drag());
    controls.addEventListener("change", () => scene.wake());
    scene.frames.add(this.#proxy, controls.getHelper());
    this.#build();
    state.on("details selected hello poses", () => this.#update());
    addEventListener("keydown", (event) => {
      if (event.key === "z" && (event.ctrlKey || event.metaKey) && !event.target.closest("input")) this.#goBack();
    });
  }

  get #frame() {
    const { selected, hello } = this.state;
    return hello.edit.includes(selected) ? selected : null;
  }

  // Whether the handle has taken the pointer, so that a click is not meant for a frame.
  get busy() {
    return this.#controls.dragging || this.#controls.axis !== null;
  }

  #build() {
    this.fields = FIELDS.map((name, k) => {
      const row = document.createElement("div");
      const field = document.createElement("input");
      Object.assign(field, { inputMode: "decimal", autocomplete: "off" });
      field.setAttribute("aria-label", `${name} in ${k < 3 ? "m" : "deg"}`);
      field.addEventListener("change", () => this.#type(k));
      field.addEventListener("keydown", (event) => {
        const sign = { ArrowUp: 1, ArrowDown: -1 }[event.key];
        if (sign) this.#step(k, sign);
        if (event.key === "Enter") field.blur();
      });
      const [less, more] = [-1, 1].map((sign) => {
        const button = document.createElement("button");
        button.textContent = sign < 0 ? "−" : "+";
        button.setAttribute("aria-label", `${sign < 0 ? "Less" : "More"} ${name}`);
        button.addEventListener("click", () => this.#step(k, sign));
        return button;
      });
      const label = document.createElement("span");
      label.textContent = name;
      row.append(label, less, field, more);
      document.getElementById(k < 3 ? "edit-xyz" : "edit-rpy").append(row);
      return field;
    });
    const modes = [["translate", "edit-move"], ["rotate", "edit-turn"]];
    for (const [mode, id] of modes) {
      document.getElementById(id).addEventListener("click", () => {
        this.#controls.setMode(mode);
        for (const [each, other] of modes) document.getElementById(other).setAttribute("aria-pressed", each === mode);
      });
    }
    document.getElementById("edit-axes").addEventListener("change", ({ target }) => {
      this.#axes = target.value;
      this.#update();
    });
    for (const id of ["step-xyz", "step-rpy"]) document.getElementById(id).addEventListener("change", () => this.#setSteps());
    this.#setSteps();
    this.undoButton.addEventListener("click", () => this.#goBack());
    document.getElementById("save").addEventListener("click", () => this.connection.send("save"));
  }

  #stepOf(k) {
    return Number(document.getElementById(k < 3 ? "step-xyz" : "step-rpy").value);
  }

  #setSteps() {
    this.#controls.setRotationSnap(THREE.MathUtils.degToRad(this.#stepOf(3)));
  }

  #update() {
    const { state } = this;
    const frame = this.#frame;
    const place = state.index.get(frame);
    this.section.hidden = frame === null;
    const { details } = state;
    if (frame === null || details.xyz === null) this.#pose = null;
    else if (this.#pose?.frame !== frame || performance.now() - this.#editedAt > QUIET) {
      if (!this.#grabbed) this.#pose = { frame, xyz: details.xyz, xyzw: details.xyzw };
    }
    const shown = this.#pose !== null && state.hasPose(place);
    if (shown && !this.#controls.object) this.#controls.attach(this.#proxy);
    if (!shown && this.#controls.object) this.#controls.detach();
    if (shown && !this.#grabbed) this.#placeProxy(place);
    this.#fillFields();
    this.undoButton.disabled = !this.#undo.some((each) => each.frame === frame);
    document.getElementById("save").disabled = !state.hello.save;
    document.getElementById("save").title = state.hello.save ? `Write ${state.hello.save}` : "The program has no file to save to";
  }

  #placeProxy(place) {
    this.#proxy.position.copy(this.scene.position(place));
    this.#proxy.quaternion.copy(this.scene.rotation(place));
    // The axes of the parent are those of the frame, turned back by its pose.
    if (this.#axes === "parent") this.#proxy.quaternion.multiply(new THREE.Quaternion(...this.#pose.xyzw).invert());
    this.#proxy.updateMatrixWorld();
  }

  #grab() {
    this.#remember();
    this.#grabbed = { ...this.#pose, at: this.#proxy.position.clone(), axes: this.#proxy.quaternion.clone() };
  }

  #release() {
    this.#grabbed = null;
    this.#update();
  }

  #drag() {
    if (!this.#grabbed) return;
    const { xyz, xyzw, at, axes } = this.#grabbed;
    const old = new THREE.Quaternion(...xyzw);
    const back = axes.clone().invert();
    const step = this.#stepOf(0);
    const moved = this.#proxy.position.clone().sub(at).applyQuaternion(back);
    if (step) moved.divideScalar(step).round().multiplyScalar(step);
    const turned = back.multiply(this.#proxy.quaternion);
    const parents = this.#axes === "parent";
    if (!parents) moved.applyQuaternion(old);
    const rotation = parents ? turned.multiply(old) : old.multiply(turned);
    this.#edit(new THREE.Vector3(...xyz).add(moved).toArray(), rotation.normalize().toArray());
  }

  #type(k) {
    const value = Number(this.fields[k].value.replace(",", "."));
    if (!this.fields[k].value.trim() || !Number.isFinite(value)) return this.#fillFields();
    this.#set(k, value);
  }

  #step(k, sign) {
    if (!this.#pose) return;
    const value = k < 3 ? this.#pose.xyz[k] : this.#angles()[k - 3];
    // Rounded far below a step, so that 0.1 + 0.2 is 0.3.
    this.#set(k, Number((value + sign * (this.#stepOf(k) || (k < 3 ? 0.01 : 1))).toFixed(9)));
  }

  #set(k, value) {
    if (!this.#pose) return;
    this.#remember();
    const { xyz, xyzw } = this.#pose;
    if (k < 3) {
      this.#edit(xyz.with(k, value), xyzw);
    } else {
      const [roll, pitch, yaw] = this.#angles().with(k - 3, value).map(THREE.MathUtils.degToRad);
      this.#edit(xyz, new THREE.Quaternion().setFromEuler(new THREE.Euler(roll, pitch, yaw, "ZYX")).toArray());
    }
    this.#fillFields(true);
  }

  // Roll, pitch and yaw in degrees.
  #angles() {
    const { x, y, z } = new THREE.Euler().setFromQuaternion(new THREE.Quaternion(...this.#pose.xyzw), "ZYX");
    return [x, y, z].map(THREE.MathUtils.radToDeg);
  }

  #remember() {
    this.#undo.push({ ...this.#pose });
    this.undoButton.disabled = false;
  }

  #goBack() {
    const at = this.#undo.findLastIndex(({ frame }) => frame === this.#frame);
    if (at < 0) return;
    const [{ xyz, xyzw }] = this.#undo.splice(at, 1);
    this.#edit(xyz, xyzw);
    this.#update();
  }

  #edit(xyz, xyzw) {
    const frame = this.#frame;
    if (frame === null) return;
    this.#pose = { frame, xyz, xyzw };
    this.#editedAt = performance.now();
    this.connection.send("edit", { frame, xyz, xyzw });
    this.#fillFields();
  }

  #fillFields(also = false) {
    const numbers = this.#pose ? [...this.#pose.xyz, ...this.#angles()] : [];
    this.fields.forEach((field, k) => {
      if (!also && document.activeElement === field) return;
      field.value = numbers.length ? Number(numbers[k].toFixed(k < 3 ? 6 : 4)) : "";
    });
  }
}
