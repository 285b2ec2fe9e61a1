// The scene of the page, and what can be done with it.
import * as THREE from "three";
import { FullScreenQuad } from "three/addons/postprocessing/Pass.js";
import { Frusta, PhotoCamera, Steering, onTap, poseOf } from "drgs/cameras";
import { Gaussians, sparkAsGsplat } from "drgs/gaussians";
import { buildPanel } from "drgs/panel";

const MOST_PIXELS = 2; // of a device's for each of the page's: more cost a phone too much

// Light is added up in 16 bits: in the 8 of a window, what many faint Gaussians give would be rounded away.
class Picture {
  constructor(canvas) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, MOST_PIXELS));
    this.target = new THREE.WebGLRenderTarget(1, 1, { type: THREE.HalfFloatType });
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      uniforms: { picture: { value: this.target.texture } },
      vertexShader: "in vec3 position; void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }",
      fragmentShader: `precision highp float;
        uniform sampler2D picture;
        out vec4 color;
        void main() { color = vec4(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb, 1.0); }`,
      depthTest: false,
      depthWrite: false,
    });
    this.quad = new FullScreenQuad(material);
  }

  resize(width, height) {
    this.renderer.setSize(width, height, false);
    this.target.setSize(this.renderer.domElement.width, this.renderer.domElement.height);
  }

  draw(world, camera) {
    this.renderer.setRenderTarget(this.target);
    this.renderer.render(world, camera);
    this.renderer.setRenderTarget(null);
    this.quad.render(this.renderer);
  }
}

export async function show(scene, bytesOfPart) {
  THREE.ColorManagement.enabled = false; // colors are the numbers of the photographs
  const asked = new URLSearchParams(location.hash.slice(1)); // #photo=NAME&time=0.5&layer=error&cameras&bare
  document.body.classList.toggle("bare", asked.has("bare"));
  const canvas = document.getElementById("canvas");
  const picture = new Picture(canvas);
  const world = new THREE.Scene();
  world.background = new THREE.Color().setRGB(...scene.background);
  const camera = new PhotoCamera(scene.near, scene.far);
  const spark = sparkAsGsplat(picture.renderer);
  const upright = new THREE.Group(); // the world of the photographs, turned so that its up is the page's
  upright.matrix.fromArray(scene.upright);
  upright.matrixAutoUpdate = false;
  const gaussians = await Gaussians.read(await bytesOfPart("gaussians"), scene.harmonics);
  const frusta = new Frusta(scene.photos, scene.reach);
  frusta.visible = asked.has("cameras");
  upright.add(gaussians.mesh, frusta);
  world.add(spark, upright);

  let due = true; // whether the picture is to be drawn again
  const changed = () => {
    due = true;
    document.body.dataset.state = "drawing";
    gaussians.touch();
  };
  spark.onDirty = () => {
    due = true;
  };
  const steering = new Steering(camera, canvas, scene.reach, changed);
  const target = new THREE.Vector3(...scene.target).applyMatrix4(upright.matrix);

  function goTo(photo) {
    const pose = poseOf(photo).premultiply(upright.matrix);
    pose.decompose(camera.position, camera.quaternion, new THREE.Vector3());
    camera.look(photo, innerWidth, innerHeight);
    camera.updateMatrixWorld();
    steering.aim(target);
    changed();
  }

  function resize() {
    picture.resize(innerWidth, innerHeight);
    camera.look(camera.lens, innerWidth, innerHeight);
    changed();
  }

  const first = scene.photos.find((photo) => photo.name === asked.get("photo")) || scene.photos[scene.first];
  goTo(first);
  addEventListener("resize", resize);
  resize();
  const panel = await buildPanel({ scene, gaussians, frusta, steering, goTo, changed, bytesOfPart, first, asked });
  onTap(canvas, (x, y) => {
    const photo = frusta.visible && frusta.at(x, y, camera);
    if (photo) {
      panel.choose(photo);
    }
  });

  let still = 0; // pictures in a row for which nothing was left to be sorted
  picture.renderer.setAnimationLoop(() => {
    steering.update();
    panel.update();
    if (due) {
      due = false;
      picture.draw(world, camera);
    }
    still = due || spark.sorting || spark.sortDirty ? 0 : still + 1;
    document.body.dataset.state = still > 3 ? "settled" : "drawing";
  });
  document.getElementById("message").hidden = true;
}
