"""A teacher for photographs: CLIP, read as a dense encoder (MaskCLIP), from weights that lie in a local folder.

CLIP's vision transformer is made for one vector an image. In its last layer every patch here attends to itself alone:
of the attention, only its value path is left (value projection, then output projection), as MaskCLIP proposes; the
residual connections, the feed-forward part, the last norm and the projection into the space shared with texts are as
trained. What comes out is a vector a patch that a text embedding can be compared with, without any training.

    a map    for each scale the photograph is resized so that its short side is scale x 2 x the model's own image size
             (448 pixels for CLIP at 224), rounded to whole patches; position embeddings are interpolated (bicubic);
             once as it is and once mirrored; vectors are divided by their lengths, resized to the map (bilinear, cells
             as areas) and averaged; then all is multiplied by 4, about the norm of LSeg's sum of four scales, for which
             the weights of Feature 3DGS's loss were chosen
    a text   the average of the unit embeddings of a name in `TEMPLATES`, of length 1

Nothing is downloaded and no pickle is run: weights are safetensors, or torch files read with `weights_only`.

Reference:
    Radford et al. 2021 (CLIP); Zhou, Loy, Dai 2022, "Extract Free Dense Labels from CLIP" (MaskCLIP), section 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drgs.checks.arguments import said
from drgs.io.json_files import check_json, read_json

SCALES = (0.75, 1.0, 1.5)
TEMPLATES = ("a photo of a {}.", "a photo of the {}.", "a {} in a scene.", "{}")
MAP_NORM = 4.0
_SHORT_SIDE = 2  # short side of the photograph at scale 1, in image sizes of the model
_MAX_SIDE = 4096  # pixels that the transformer may see along a side: its attention grows with their fourth power
# CLIP's own
_MEAN = (0.48145466, 0.4578275, 0.40821073)
_STD = (0.26862954, 0.26130258, 0.27577711)
_WEIGHTS = (
    "model.safetensors",
    "model.safetensors.index.json",
    "pytorch_model.bin",
    "pytorch_model.bin.index.json",
)
_TOKENIZERS = (("tokenizer.json",), ("vocab.json", "merges.txt"))
_ADVICE = "name a folder with a CLIP model as transformers saves it (config.json, model.safetensors, tokenizer.json)"


class ClipEncoder:
    """A CLIP model (transformers' `CLIPModel`) from a folder.

    Args:
        folder: Folder with config.json, the weights, preprocessor_config.json (its mean and standard deviation of
            colors; CLIP's own without it), and for `texts` the tokenizer.
        device: torch device that it runs on.
    Raises:
        FileNotFoundError: If transformers is not installed, or there is no such folder, config or weights.
        ValueError: If it is another kind of model, a file is damaged, or weights are missing in it.
    """

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        self.folder = Path(folder)
        self.device = device
        transformers = _transformers()
        self._config = _checked_config(self.folder)
        weights = next((name for name in _WEIGHTS if (self.folder / name).is_file()), None)
        if weights is None:
            raise FileNotFoundError(f"{self.folder}: must hold the weights {_WEIGHTS[0]}, found none; {_ADVICE}")
        self.weights = self.folder / weights
        try:
            self._model, report = transformers.CLIPModel.from_pretrained(
                str(self.folder),
                local_files_only=True,
                use_safetensors="safetensors" in weights,
                weights_only=True,
                dtype=torch.float32,
                output_loading_info=True,
            )
        except Exception as error:  # of a damaged file, whatever its bytes make the parsers raise
            raise ValueError(
                f"{self.weights}: must be weights of CLIP, got {said(error, 160)}; copy them again"
            ) from None
        missing = sorted(report["missing_keys"]) + sorted(map(str, report["mismatched_keys"]))
        if missing:  # transformers would go on with random numbers in their place
            raise ValueError(
                f"{self.weights}: must hold all weights of CLIP, {len(missing)} are missing, {missing[0]} first; "
                "copy them again"
            )
        self._model.eval().to(device)
        self._mean, self._std = _colors(self.folder)

    @property
    def channels(self) -> int:
        """C, of features and text embeddings."""
        return self._config["projection_dim"]

    @property
    def patch(self) -> int:
        """Pixels of a patch's side."""
        return self._config["vision_config"]["patch_size"]

    @property
    def has_texts(self) -> bool:
        """Whether the folder holds a tokenizer."""
        return any(all((self.folder / name).is_file() for name in names) for names in _TOKENIZERS)

    def dense(
        self, image: np.ndarray, size: tuple[int, int], scales: Sequence[float] = SCALES, flip: bool = True
    ) -> torch.Tensor:
        """Features of a photograph, by the module's text.

        Args:
            image: (H, W, 3) float in [0, 1].
            size: (w, h) of the map.
            scales: Sizes of the photograph that are averaged, one or more.
            flip: Whether the mirrored photograph is averaged, too.
        Returns:
            (C, h, w) float32, on the CPU.
        Raises:
            ValueError: If a scale makes the photograph larger than 4096 pixels.
        """
        width, height = size
        total = torch.zeros(self.channels, height, width)
        for scale in scales:
            pixels = self._pixels(image, scale)
            found = self.patches(pixels)
            if flip:
                mirrored = self.patches(pixels.flip(3)).flip(2)  # back again, so that patches lie on one another
                found = torch.stack([_unit(found), _unit(mirrored)]).mean(0)
            resized = torch.nn.functional.interpolate(_unit(found)[None], (height, width), mode="bilinear")[0]
            total += resized.cpu()
        return MAP_NORM / len(scales) * total

    @torch.no_grad()  # a teacher is not trained
    def patches(self, pixels: torch.Tensor) -> torch.Tensor:
        """(C, H / patch, W / patch) features of (1, 3, H, W) normalized pixels, one a patch, not normalized."""
        vision = self._model.vision_model
        hidden = vision.pre_layrnorm(vision.embeddings(pixels.to(self.device), interpolate_pos_encoding=True))
        *layers, last = vision.encoder.layers
        for layer in layers:
            hidden = layer(hidden, None)
        hidden = hidden[:, 1:]  # patches look at nothing else from here on, at the class token neither
        attention = last.self_attn
        hidden = hidden + attention.out_proj(attention.v_proj(last.layer_norm1(hidden)))
        hidden = hidden + last.mlp(last.layer_norm2(hidden))
        found = self._model.visual_projection(vision.post_layernorm(hidden))[0]
        return found.T.reshape(self.channels, *(side // self.patch for side in pixels.shape[2:]))

    @torch.no_grad()  # a teacher is not trained
    def texts(self, names: Sequence[str]) -> torch.Tensor:
        """(K, C) float32 embeddings of length 1, on the CPU, by the module's text.

        Raises:
            FileNotFoundError: If the folder holds no tokenizer.
            ValueError: If its files are damaged, or it makes numbers that the model does not know.
        """
        if not self.has_texts:
            raise FileNotFoundError(
                f"{self.folder}: must hold a tokenizer (tokenizer.json) for class names, found none; {_ADVICE}"
            )
        try:
            tokenizer = _transformers().CLIPTokenizer.from_pretrained(str(self.folder), local_files_only=True)
            rows = []
            for name in names:
                tokens = tokenizer([text.format(name) for text in TEMPLATES], padding=True, truncation=True,
                                   max_length=self._config["text_config"].get("max_position_embeddings", 77),
                                   return_tensors="pt").to(self.device)  # fmt: skip
                found = self._model.get_text_features(**tokens).pooler_output
                rows.append(torch.nn.functional.normalize(found, dim=1).mean(0).cpu())
        except Exception as error:  # of a damaged file, whatever its bytes make the parsers raise
            raise ValueError(
                f"{self.folder}: its tokenizer must be that of its model, got {said(error, 160)}; copy it again"
            ) from None
        return torch.nn.functional.normalize(torch.stack(rows), dim=1)

    def _pixels(self, image: np.ndarray, scale: float) -> torch.Tensor:
        """(1, 3, H, W) normalized pixels of whole patches."""
        import cv2

        height, width = image.shape[:2]
        short = scale * _SHORT_SIDE * self._config["vision_config"]["image_size"]
        factor = short / min(height, width)
        size = [max(1, round(side * factor / self.patch)) * self.patch for side in (width, height)]
        if max(size) > _MAX_SIDE:
            raise ValueError(
                f"scale {scale:g}: the photograph must have at most {_MAX_SIDE} pixels a side for the model, would "
                f"have {size[0]}x{size[1]}; choose a smaller one"
            )
        how = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
        resized = cv2.resize(np.ascontiguousarray(image, np.float32), size, interpolation=how).clip(0, 1)
        normalized = (resized - self._mean) / self._std
        return torch.from_numpy(np.ascontiguousarray(normalized.transpose(2, 0, 1)))[None]


def _unit(features: torch.Tensor) -> torch.Tensor:
    """Vectors along the first axis, of length 1."""
    return torch.nn.functional.normalize(features, dim=0)


def _transformers() -> Any:
    """The package, with nothing of its own on stderr."""
    try:
        import transformers
    except ImportError:
        raise FileNotFoundError(
            "the package transformers must be installed for a teacher, it is not; run pip install 'drgs[teacher]'"
        ) from None
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    return transformers


def _checked_config(folder: Path) -> dict[str, Any]:
    """config.json of a CLIP model, with the fields that are used."""
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "found none"
        raise FileNotFoundError(f"{folder}: must be a folder with a model, {what}; {_ADVICE}")
    path = folder / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"{folder}: must hold config.json and weights of CLIP, found no config.json; {_ADVICE}")
    config = read_json(path, "the config.json of a CLIP model", _ADVICE)
    kind = config.get("model_type") if isinstance(config, dict) else None
    if kind != "clip":
        raise ValueError(f"{path}: model_type must be 'clip', got {kind!r}; {_ADVICE}")
    fields = {"projection_dim": int, "vision_config": dict, "text_config": dict}
    config.setdefault("projection_dim", 512)  # what transformers takes where a file leaves it out
    check_json(str(path), config, fields, _ADVICE)
    vision = config["vision_config"]
    for name, usual in (("image_size", 224), ("patch_size", 32)):
        vision.setdefault(name, usual)
    check_json(f"{path}: vision_config", vision, {"image_size": int, "patch_size": int}, _ADVICE)
    if not 0 < vision["patch_size"] <= vision["image_size"] <= _MAX_SIDE:
        raise ValueError(
            f"{path}: vision_config must have 0 < patch_size <= image_size <= {_MAX_SIDE}, got "
            f"{vision['patch_size']} and {vision['image_size']}; {_ADVICE}"
        )
    return config


def _colors(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation that colors are normalized with, (3,) float32 each."""
    path = folder / "preprocessor_config.json"
    values = {}
    if path.is_file():
        values = read_json(path, "a preprocessor_config.json", "copy it again")
        check_json(str(path), values, {}, "copy it again")
    mean, std = (values.get(key, usual) for key, usual in (("image_mean", _MEAN), ("image_std", _STD)))
    found = {"image_mean": list(mean), "image_std": list(std)}
    check_json(str(path), found, {"image_mean": [float], "image_std": [float]}, "copy it again")
    if len(mean) != 3 or len(std) != 3 or min(std) <= 0:
        raise ValueError(f"{path}: image_mean and image_std must be 3 numbers, image_std > 0; copy it again")
    return np.array(mean, np.float32), np.array(std, np.float32)
