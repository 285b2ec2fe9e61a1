// Cameras of photographs: the one that looks at the scene, and those that are drawn in it.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { FpsMovement, PointerControls } from "@sparkjsdev/spark";

const NEAR_ENOUGH = 24; // pixels between a tap and the camera that it means
const A_TAP = 6; // pixels that a finger may move meanwhile
const SIZE = 0.07; // of a camera that is drawn, in distances to what the photographs look at

// A window onto what a photograph shows: all of it, and more on two sides where the window has another shape.
export class PhotoCamera extends THREE.PerspectiveCamera {
  constructor(near, far) {
    super();
    this.near = near;
    this.far = far;
  }

  look(lens, width, height) {
    this.lens = lens;
    this.shape = [width, height];
    this.updateProjectionMatrix();
  }

  updateProjectionMatrix() {
    if (!this.lens) {
      return;
    }
    const { width, height, fx, fy, cx, cy } = this.lens;
    const scale = Math.min(this.shape[0] / width, this.shape[1] / height);
    const [across, down] = this.shape.map((side) => side / scale); // of the window, in the photograph's pixels
    const left = -cx - 0.5 * (across - width);
    const top = cy + 0.5 * (down - height);
    const edges = [left / fx, (left + across) / fx, top / fy, (top - down) / fy].map((slope) => slope * this.near);
    this.projectionMatrix.makePerspective(...edges, this.near, this.far);
    this.projectionMatrixInverse.copy(this.projectionMatrix).invert();
    this.fov = THREE.MathUtils.radToDeg(2 * Math.atan((0.5 * down) / fy)); // controls go by it
    this.aspect = this.shape[0] / this.shape[1];
  }
}

// Around what is looked at, or through it: one way or the other by finger and mouse, both by keys.
export class Steering {
  constructor(camera, canvas, reach, changed) {
    this.camera = camera;
    this.canvas = canvas;
    this.reach = reach; // distance to what the photographs look at: steps are parts of it
    this.changed = changed;
    this.orbit = new OrbitControls(camera, canvas);
    this.orbit.addEventListener("change", changed);
    this.keys = new FpsMovement({ moveSpeed: 0.6 * reach });
    this.pointer = null;
    this.last = 0;
  }

  // Turn around a point on the optical axis as far as the given one, so that nothing jumps when a finger moves.
  aim(point) {
    const axis = this.camera.getWorldDirection(new THREE.Vector3());
    const distance = axis.dot(point.clone().sub(this.camera.position));
    this.distance = distance > 0.05 * this.reach ? distance : this.reach;
    this.orbit.target.copy(this.camera.position).addScaledVector(axis, this.distance);
  }

  get isFlying() {
    return Boolean(this.pointer && this.pointer.enable);
  }

  fly(isOn) {
    if (isOn) {
      const { canvas, reach } = this;
      this.pointer ??= new PointerControls({ canvas, slideSpeed: 0.004 * reach, scrollSpeed: 0.001 * reach });
      this.pointer.rotating = this.pointer.sliding = null;
      this.pointer.scroll.set(0, 0, 0);
    }
    if (this.pointer) {
      this.pointer.enable = isOn;
    }
    this.orbit.enabled = !isOn;
  }

  // To be called once a picture: what keys and fingers have done since the last one.
  update() {
    const now = performance.now();
    const seconds = Math.min((now - this.last) / 1000, 0.1);
    this.last = now;
    const moved = this.keys.update(seconds, this.camera);
    const turned = this.pointer ? this.pointer.update(seconds, this.camera, this.camera) : false;
    if (moved || turned) {
      const axis = this.camera.getWorldDirection(new THREE.Vector3());
      this.orbit.target.copy(this.camera.position).addScaledVector(axis, this.distance);
      this.changed();
    }
  }
}

// Cameras as pyramids of lines, which a tap goes to.
export class Frusta extends THREE.Group {
  constructor(photos, reach) {
    super();
    this.photos = photos;
    this.places = photos.map((photo) => new THREE.Vector3().setFromMatrixPosition(poseOf(photo)));
    const kinds = { fitted: 0x4287f5, next: 0xff9a1f };
    for (const [kind, color] of Object.entries(kinds)) {
      const points = photos.filter((photo) => photo.kind === kind).flatMap((photo) => pyramid(photo, SIZE * reach));
      const geometry = new THREE.BufferGeometry().setFromPoints(points);
      this.add(new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color })));
    }
  }

  // The photograph whose camera is drawn where a tap is; undefined where none is.
  at(x, y, camera) {
    const near = this.photos.map((photo, i) => {
      const place = this.places[i].clone().applyMatrix4(this.matrixWorld).project(camera);
      const away = Math.hypot((0.5 + 0.5 * place.x) * innerWidth - x, (0.5 - 0.5 * place.y) * innerHeight - y);
      return { photo, away: Math.abs(place.z) < 1 ? away : Infinity };
    });
    const best = near.reduce((a, b) => (b.away < a.away ? b : a), { away: NEAR_ENOUGH });
    return best.photo;
  }
}

export const poseOf = (photo) => new THREE.Matrix4().fromArray(photo.pose);

function pyramid({ width, height, fx, fy, cx, cy, ...photo }, depth) {
  const pose = poseOf(photo);
  const at = (x, y) => new THREE.Vector3((x - cx) / fx, (cy - y) / fy, -1).multiplyScalar(depth).applyMatrix4(pose);
  const eye = new THREE.Vector3().setFromMatrixPosition(pose);
  const corners = [at(0, 0), at(width, 0), at(width, height), at(0, height)];
  const tip = new THREE.Vector3((0.5 * width - cx) / fx, (cy + 0.12 * height) / fy, -1);
  tip.multiplyScalar(depth).applyMatrix4(pose); // says which side is up
  const lines = [corners[0], tip, tip, corners[1]];
  corners.forEach((corner, i) => lines.push(eye, corner, corner, corners[(i + 1) % 4]));
  return lines;
}

// Calls a function with the place of every tap that is no drag.
export function onTap(canvas, call) {
  let start = null;
  canvas.addEventListener("pointerdown", (event) => {
    start = event.isPrimary ? event : null;
  });
  canvas.addEventListener("pointerup", (event) => {
    if (start && Math.hypot(event.clientX - start.clientX, event.clientY - start.clientY) < A_TAP) {
      call(event.clientX, event.clientY);
    }
    start = null;
  });
}
