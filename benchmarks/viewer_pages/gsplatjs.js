// gsplat.js, out of the client of gradio, whose Model3D opens .ply files of Gaussians with it. The server adds an export
// of its classes to the module, and takes the imports from it that are of the page around it.
import { axes, canvasOf, keepDrawing } from "./common.js";

export async function open({ module, model, view, far }) {
  const { Scene, Camera, Renderer, PLYLoader } = await import(module);
  const canvas = canvasOf(view);
  const renderer = new Renderer(canvas);
  const scene = new Scene();
  const camera = new Camera();
  if (far !== null) camera.data.far = far; // else its own 100
  await PLYLoader.LoadAsync(model, scene, () => {});
  const look = (next) => {
    const { center, right, down, forward } = axes(next);
    camera.data.setSize(next.width, next.height);
    camera.data.fx = next.fx;
    camera.data.fy = next.fy;
    const Vector3 = camera.position.constructor;
    const Quaternion = camera.rotation.constructor;
    camera.position = new Vector3(...center);
    // Its cameras have OpenCV's axes; columns of the rotation are the axes in the world.
    camera.rotation = quaternion(Quaternion, [0, 1, 2].map((i) => [right[i], down[i], forward[i]]));
    camera.update();
  };
  renderer.setSize(view.width, view.height);
  look(view);
  keepDrawing(() => renderer.render(scene, camera));
  return { look };
}

/** Unit quaternion of a rotation matrix, whose largest component is computed first. */
function quaternion(Quaternion, m) {
  const squares = [
    1 + m[0][0] - m[1][1] - m[2][2],
    1 - m[0][0] + m[1][1] - m[2][2],
    1 - m[0][0] - m[1][1] + m[2][2],
    1 + m[0][0] + m[1][1] + m[2][2],
  ];
  const rows = [
    [squares[0], m[1][0] + m[0][1], m[0][2] + m[2][0], m[2][1] - m[1][2]],
    [m[1][0] + m[0][1], squares[1], m[2][1] + m[1][2], m[0][2] - m[2][0]],
    [m[0][2] + m[2][0], m[2][1] + m[1][2], squares[2], m[1][0] - m[0][1]],
    [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], squares[3]],
  ];
  const row = rows[squares.indexOf(Math.max(...squares))];
  const length = Math.hypot(...row);
  return new Quaternion(...row.map((x) => x / length));
}
