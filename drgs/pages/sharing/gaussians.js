// The Gaussians as gsplat draws them, and what is known of each: classes, errors, where it is at other times.
import * as THREE from "three";
import { ExtSplats, RgbaArray, SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";

const SIGMAS = Math.sqrt(2 * Math.log(255)); // gsplat leaves out what is below 1 / 255 of an opacity of 1
const NO_LIMIT = 1e5; // pixels of a Gaussian's radius, and half pictures that its center is beside the picture

export function sparkAsGsplat(renderer) {
  const spark = new SparkRenderer({
    renderer,
    preBlurAmount: 0.3,
    blurAmount: 0,
    maxStdDev: SIGMAS,
    minAlpha: 1 / 255,
    maxPixelRadius: NO_LIMIT,
    clipXY: NO_LIMIT,
    sortRadial: false,
    accumExtSplats: true,
    enableLod: false,
  });
  // gsplat bounds the slopes of Gaussians beyond the picture's edge: else those near the camera are smeared over it.
  spark.material.vertexShader = replaced(
    spark.material.vertexShader,
    "vec2 J2 = -(J1 * viewCenter.xy) * invZ;",
    `vec2 reach = 1.0 / vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
     vec2 middle = vec2(projectionMatrix[2][0], projectionMatrix[2][1]) * reach;
     vec2 J2 = J1 * clamp(-viewCenter.xy * invZ, middle - 1.3 * reach, middle + 1.3 * reach);`,
  );
  // Colors are the numbers of the photographs, which no color space changes on the way.
  spark.material.fragmentShader = replaced(spark.material.fragmentShader, "if (encodeLinear)", "if (false)");
  return spark;
}

function replaced(shader, text, by) {
  if (!shader.includes(text)) {
    throw new Error("the viewer's shader is another one than this page was made for");
  }
  return shader.replace(text, by);
}

export class Gaussians {
  // Reads the archive of SOG; `harmonics` says where in it those are.
  static async read(archive, harmonics) {
    const splats = new ExtSplats({ fileBytes: archive.slice(), fileType: SplatFileType.PCSOGSZIP, lod: false });
    await splats.initialized;
    if (harmonics) {
      await restoreHarmonics(splats, archive, harmonics);
    }
    const mesh = new SplatMesh({ extSplats: splats, lod: false });
    await mesh.initialized;
    return new Gaussians(splats, mesh);
  }

  constructor(splats, mesh) {
    this.splats = splats;
    this.mesh = mesh;
    this.count = splats.numSplats;
    // Words with the opacities at the time that is shown, of which hidden ones are set to 0.
    this.opaque = splats.extArrays[0].slice();
    this.isHidden = () => false;
    this.colors = null;
  }

  // Draws all but those for which the function of an index is true.
  hide(isHidden) {
    this.isHidden = isHidden;
    const words = this.splats.extArrays[0];
    for (let i = 0; i < this.count; i++) {
      const word = this.opaque[4 * i + 3];
      words[4 * i + 3] = isHidden(i) ? word & 0xffff0000 : word; // the opacity is the lower half
    }
    this.upload();
    if (this.colors) {
      this.tint(this.colors);
    }
  }

  // Draws them in other colors, (N, 3) bytes; null: in their own.
  tint(colors) {
    this.colors = colors;
    if (this.mesh.splatRgba) {
      this.mesh.splatRgba.dispose();
    }
    this.mesh.splatRgba = null;
    if (colors) {
      const array = new Uint8Array(4 * this.count);
      for (let i = 0; i < this.count; i++) {
        array.set(colors.subarray(3 * i, 3 * i + 3), 4 * i);
        array[4 * i + 3] = Math.round(255 * this.splats.getSplat(i).opacity);
      }
      this.mesh.splatRgba = new RgbaArray({ array });
    }
    this.mesh.updateGenerator();
  }

  // Moves some of them: `places` are their indices, `poseOf(k, center, scales, quaternion)` says where the k-th is, and
  // returns its opacity over that of the file.
  move(places, poseOf) {
    this.opacities ??= Float32Array.from(places, (index) => this.splats.getSplat(index).opacity);
    const words = this.splats.extArrays[0];
    places.forEach((index, k) => {
      const { center, scales, quaternion, color } = this.splats.getSplat(index);
      const share = poseOf(k, center, scales, quaternion);
      this.splats.setSplat(index, center, scales, quaternion, share * this.opacities[k], color);
      this.opaque[4 * index + 3] = words[4 * index + 3];
    });
    this.hide(this.isHidden); // which the new opacities have undone
  }

  // Spark is told of a change, be it of these or of the camera, however little: it colors and sorts them anew.
  touch() {
    this.mesh.updateVersion();
  }

  upload() {
    this.splats.textures.forEach((texture) => {
      texture.needsUpdate = true;
    });
    this.touch();
  }
}

// Spark 2.2 packs spherical harmonics into bytes of a power of two that is too small by one, and cuts off what is above
// it, by up to a half. They are packed anew here from the pictures of the archive that hold them.
async function restoreHarmonics(splats, archive, { each, rows, codebook, centroids, labels, sums }) {
  const palette = await pixelsOf(archive.slice(...centroids));
  const chosen = await pixelsOf(archive.slice(...labels));
  if (sumOf(palette) !== sums[0] || sumOf(chosen) !== sums[1]) {
    return; // a browser that blurs what pages read of pictures, lest it be recognized: Spark's own must do
  }
  const words = new Uint32Array(rows * each); // of each row, pixel by pixel
  for (let i = 0; i < words.length; i++) {
    words[i] = packedColor([0, 1, 2].map((channel) => codebook[palette[4 * i + channel]]));
  }
  const { sh1, sh2, sh3a, sh3b } = splats.extra;
  const arrays = [sh1, sh2, sh3a, sh3b]; // of four coefficients each
  for (let i = 0; i < splats.numSplats; i++) {
    const row = chosen[4 * i] + 256 * chosen[4 * i + 1];
    for (let k = 0; k < each; k++) {
      arrays[k >> 2][4 * i + (k & 3)] = words[row * each + k];
    }
  }
}

// Three numbers in a byte each, their signs, and the power of two that the largest is below, as Spark reads them.
function packedColor(color) {
  const largest = Math.max(...color.map(Math.abs), 2 ** -15);
  const power = Math.min(Math.ceil(Math.log2(largest)) + 15, 31);
  const unit = 2 ** (power - 15) / 255;
  let word = power << 27;
  color.forEach((value, i) => {
    word |= Math.min(Math.round(Math.abs(value) / unit), 255) << (8 * i);
    word |= value < 0 ? 1 << (24 + i) : 0;
  });
  return word;
}

async function pixelsOf(webp) {
  const plain = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
  const picture = await createImageBitmap(new Blob([webp], { type: "image/webp" }), plain);
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [picture.width, picture.height];
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(picture, 0, 0);
  return context.getImageData(0, 0, picture.width, picture.height).data;
}

const sumOf = (bytes) => bytes.reduce((sum, byte, i) => (sum + byte * ((i & 255) + 1)) % 2 ** 32, 0);
