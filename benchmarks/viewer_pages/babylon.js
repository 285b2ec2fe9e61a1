// The viewer of Babylon.js, out of the client of gradio, whose Model3D opens .ply files of triangles with it.
import { axes, canvasOf, projectionMatrix } from "./common.js";

export async function open({ module, model, view, far }) {
  // The bundle asks for the global of Babylon Native without `typeof`, which is an error where there is none.
  globalThis._native = undefined;
  const { CreateViewerForCanvas } = await import(module);
  const canvas = canvasOf(view);
  let details;
  const viewer = await CreateViewerForCanvas(canvas, {
    engine: "WebGL",
    clearColor: [0, 0, 0, 1],
    environmentLighting: "none",
    useRightHandedSystem: true,
    cameraAutoOrbit: { enabled: false },
    autoSuspendRendering: false,
    antialias: false,
    onInitialized: (found) => (details = found),
  });
  const bytes = await (await fetch(model)).arrayBuffer();
  await viewer.loadModel(new File([bytes], "model.ply"));
  const { scene, camera } = details;
  const mesh = scene.meshes.find((found) => found.getClassName().startsWith("GaussianSplatting"));
  // The loader mirrors y, for its own scenes: the world of the cameras is that of the file.
  mesh.scaling.setAll(1);
  mesh.rotation?.setAll(0);
  const Vector3 = camera.upVector.constructor;
  const Matrix = mesh.getWorldMatrix().constructor;
  camera.lowerRadiusLimit = camera.upperRadiusLimit = camera.lowerBetaLimit = camera.upperBetaLimit = null;
  camera.minZ = 0.01;
  camera.maxZ = far;
  let shown = view;
  const apply = () => {
    const { center, down, forward } = axes(shown);
    camera.upVector = new Vector3(...down.map((x) => -x));
    camera.setTarget(new Vector3(...center.map((x, i) => x + forward[i])));
    camera.setPosition(new Vector3(...center));
    const p = projectionMatrix(shown, camera.minZ, camera.maxZ);
    const columns = [0, 1, 2, 3].flatMap((j) => [0, 1, 2, 3].map((i) => p[4 * i + j]));
    camera.freezeProjectionMatrix(Matrix.FromArray(columns));
  };
  scene.onBeforeRenderObservable.add(apply);
  const look = (next) => {
    shown = next;
    apply();
    details.markSceneMutated?.();
  };
  look(view);
  return { look };
}
