// Spark (three.js), out of the client of vuer: everything that vuer's client exports under a short name keeps its own
// name in the list of exports, which the server reads (`names`).
import { canvasOf, keepDrawing, projectionMatrix, viewMatrix } from "./common.js";

export async function open({ module, names, model, view, options, far }) {
  const loaded = await import(module);
  const of = (name) => loaded[names[name]];
  const canvas = canvasOf(view);
  const renderer = new (of("WebGLRenderer"))({ canvas, antialias: false });
  renderer.setPixelRatio(1);
  renderer.setSize(view.width, view.height, false);
  renderer.setClearColor(0x000000, 1);
  const scene = new (of("Scene"))();
  // The class of perspective cameras has no export of its own; those of the six sides of a cube are of it.
  const camera = new (new (of("CubeCamera"))(0.01, far, null).children[0].constructor)();
  camera.matrixAutoUpdate = false;
  const spark = new (of("SparkRenderer"))({ renderer, ...options });
  scene.add(spark);
  // As vuer's own component loads a file.
  const packedSplats = await new (of("SplatLoader"))().loadAsync(model);
  const mesh = new (of("SplatMesh"))({ packedSplats });
  await mesh.initialized;
  scene.add(mesh);
  const Matrix4 = of("Matrix4");
  const look = (next) => {
    camera.matrix.copy(new Matrix4().set(...viewMatrix(next)).invert());
    camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
    camera.updateMatrixWorld(true);
    camera.near = 0.01;
    camera.far = far;
    camera.projectionMatrix.set(...projectionMatrix(next, camera.near, camera.far));
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  };
  look(view);
  keepDrawing(() => renderer.render(scene, camera));
  return { look };
}
