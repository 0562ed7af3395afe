// Lines and dots whose width is a number of pixels at every distance, which WebGL's own lines have not.
//
// Colours are written as they are given, so that a state has the same colour here as in every other picture.

import * as THREE from "./three/three.module.min.js";

export class Lines extends THREE.Mesh {
  #capacity = 0;

  constructor(width, { under = false } = {}) {
    const material = new THREE.ShaderMaterial({
      uniforms: { width: { value: width }, view: { value: new THREE.Vector2(1, 1) } },
      vertexShader: `
        attribute vec3 begin, finish, tint;
        uniform float width; uniform vec2 view; varying vec3 colour;
        void main() {
          vec4 a = projectionMatrix * modelViewMatrix * vec4(begin, 1.0);
          vec4 b = projectionMatrix * modelViewMatrix * vec4(finish, 1.0);
          float near = 1e-4;  // An end behind the camera has no place on the screen.
          if (a.w < near && b.w > near) a = mix(a, b, (near - a.w) / (b.w - a.w));
          if (b.w < near && a.w > near) b = mix(b, a, (near - b.w) / (a.w - b.w));
          vec2 along = (b.xy / b.w - a.xy / a.w) * view;
          vec2 across = length(along) > 0.0 ? normalize(vec2(-along.y, along.x)) : vec2(0.0);
          vec4 end = position.x < 0.5 ? a : b;
          end.xy += across * position.y * width / view * end.w;
          gl_Position = end;
          colour = tint;
        }`,
      fragmentShader: "varying vec3 colour; void main() { gl_FragColor = vec4(colour, 1.0); }",
      side: THREE.DoubleSide,
      depthWrite: !under,
    });
    super(new THREE.InstancedBufferGeometry(), material);
    this.frustumCulled = false;
    this.renderOrder = under ? -1 : 0;
    this.#reserve(16);
    this.geometry.instanceCount = 0;
    this.onBeforeRender = (renderer) => renderer.getSize(material.uniforms.view.value);
  }

  #reserve(capacity) {
    this.#capacity = capacity;
    this.geometry.dispose();
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute([0, -1, 0, 0, 1, 0, 1, -1, 0, 1, 1, 0], 3));
    geometry.setIndex([0, 1, 2, 2, 1, 3]);
    for (const name of ["begin", "finish", "tint"]) {
      geometry.setAttribute(name, new THREE.InstancedBufferAttribute(new Float32Array(3 * capacity), 3));
    }
    this.geometry = geometry;
  }

  // Draw `count` lines at most; `fill(k, begin, finish, tint)` writes three numbers each, and says whether it has.
  draw(count, fill) {
    if (count > this.#capacity) this.#reserve(2 * count);
    const { begin, finish, tint } = this.geometry.attributes;
    let drawn = 0;
    for (let k = 0; k < count; k++) {
      const at = [3 * drawn, 3 * drawn + 3];
      if (fill(k, begin.array.subarray(...at), finish.array.subarray(...at), tint.array.subarray(...at))) drawn++;
    }
    for (const attribute of [begin, finish, tint]) attribute.needsUpdate = true;
    this.geometry.instanceCount = drawn;
  }
}

export class Dots extends THREE.Points {
  #capacity = 0;

  constructor() {
    const material = new THREE.ShaderMaterial({
      uniforms: { ratio: { value: 1 }, ring: { value: new THREE.Color() } },
      vertexShader: `
        attribute vec3 tint; attribute float size; uniform float ratio; varying vec3 colour; varying float radius;
        void main() {
          gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
          gl_Position.z -= 1e-3 * gl_Position.w;  // Before the axes of the same frame.
          gl_PointSize = size * ratio;
          colour = tint; radius = size * 0.5;
        }`,
      fragmentShader: `
        uniform vec3 ring; varying vec3 colour; varying float radius;
        void main() {
          float distance = length(gl_PointCoord - 0.5) * 2.0 * radius;
          if (distance > radius) discard;
          gl_FragColor = vec4(distance > radius - 1.2 ? ring : colour, 1.0);
        }`,
    });
    super(new THREE.BufferGeometry(), material);
    this.frustumCulled = false;
    this.draw(0);
  }

  draw(count, fill) {
    if (count > this.#capacity || !this.#capacity) {
      this.#capacity = 2 * count + 16;
      this.geometry.dispose();
      this.geometry = new THREE.BufferGeometry();
      for (const [name, width] of [["position", 3], ["tint", 3], ["size", 1]]) {
        this.geometry.setAttribute(name, new THREE.BufferAttribute(new Float32Array(width * this.#capacity), width));
      }
    }
    const { position, tint, size } = this.geometry.attributes;
    for (let k = 0; k < count; k++) {
      size.array[k] = fill(k, position.array.subarray(3 * k, 3 * k + 3), tint.array.subarray(3 * k, 3 * k + 3));
    }
    for (const attribute of [position, tint, size]) attribute.needsUpdate = true;
    this.geometry.setDrawRange(0, count);
  }
}
