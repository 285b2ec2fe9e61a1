// Cameras of drgs (OpenCV's axes: +x right, +y down, +z forward) as WebGL has them, and what every page offers.

/** World to camera with OpenGL's axes (+y up, -z forward): 16 numbers, row by row. */
export function viewMatrix(view) {
  return view.world_to_camera.map((x, i) => (i >= 4 && i < 12 ? -x : x));
}

/** Projection of a pinhole, its principal point where it is: 16 numbers, row by row. */
export function projectionMatrix(view, near, far) {
  const { width, height, fx, fy, cx, cy } = view;
  return [
    (2 * fx) / width, 0, 1 - (2 * cx) / width, 0,
    0, (2 * fy) / height, (2 * cy) / height - 1, 0,
    0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near),
    0, 0, -1, 0,
  ];
}

/** Center, and the directions to the right, down and forward, of a camera in the world. */
export function axes(view) {
  const m = view.world_to_camera;
  const [right, down, forward] = [0, 4, 8].map((i) => m.slice(i, i + 3));
  const center = [0, 1, 2].map((j) => -(right[j] * m[3] + down[j] * m[7] + forward[j] * m[11]));
  return { center, right, down, forward };
}

/** A canvas of the size of the views, in pixels of the screen, on black. */
export function canvasOf(view) {
  document.body.style.cssText = "margin: 0; background: black; overflow: hidden";
  const canvas = document.createElement("canvas");
  canvas.width = view.width;
  canvas.height = view.height;
  canvas.style.cssText = `display: block; width: ${view.width}px; height: ${view.height}px`;
  document.body.append(canvas);
  return canvas;
}

/** Draw again and again, so that an order that a worker has sorted meanwhile is seen. */
export function keepDrawing(draw) {
  const next = () => {
    draw();
    requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
}
