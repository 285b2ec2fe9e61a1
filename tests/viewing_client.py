"""What a browser says to the viewer and hears from it, without a browser: viser's messages over a WebSocket."""

from __future__ import annotations

import time
from typing import Any

import cv2
import msgspec
import numpy as np
import viser
import zstandard
from websockets.sync.client import connect

PROTOCOL = f"viser-v{viser.__version__}"


class Client:
    """One connection; its window is 160x120."""

    def __init__(self, port: int, **options: Any) -> None:
        options = {"subprotocols": [PROTOCOL], "max_size": None, "open_timeout": 20, **options}
        self._socket = connect(f"ws://127.0.0.1:{port}/", **options)
        self.heard: list[dict[str, Any]] = []

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def look(self, wxyz, position, fov: float = 0.8, width: int = 160, height: int = 120, other: Any = ()) -> None:
        """Say where the camera is; with `other` fields of the message instead."""
        message = {
            "type": "ViewerCameraMessage",
            "wxyz": [float(x) for x in wxyz],
            "position": [float(x) for x in position],
            "fov": fov,
            "near": 0.01,
            "far": 100.0,
            "image_height": height,
            "image_width": width,
            "look_at": [0.0, 0.0, 0.0],
            "up_direction": [0.0, -1.0, 0.0],
        }
        self.send(**message | dict(other))

    def choose(self, label: str, value: Any) -> None:
        """Give an input of the panel another value."""
        found = self.wait(lambda m: (m.get("props") or {}).get("label") == label and "uuid" in m)
        self.send(type="GuiUpdateMessage", uuid=found["uuid"], updates={"value": value})

    def click(self, number: int) -> None:
        """Click on a frustum."""
        found = self.wait(lambda m: m.get("name") == f"/cameras/{number}" and "props" in m)
        self.send(
            type="SceneNodeClickMessage",
            name=found["name"],
            instance_index=None,
            ray_origin=[0.0, 0.0, 0.0],
            ray_direction=[0.0, 0.0, 1.0],
            screen_pos=[0.5, 0.5],
            modifier=None,
            owner=found.get("owner", ""),
        )

    def send(self, **message: Any) -> None:
        self.send_bytes(msgspec.msgpack.encode(message))

    def send_bytes(self, data: bytes | str) -> None:
        """Send what may be no message."""
        self._socket.send(data)

    def wait(self, wanted, seconds: float = 60.0, after: int = 0) -> dict[str, Any]:
        """The first message heard, of those from number `after` on, that is wanted."""
        end = time.monotonic() + seconds
        while True:
            for message in self.heard[after:]:
                if wanted(message):
                    return message
            left = end - time.monotonic()
            assert left > 0, f"never heard; last: {[m['type'] for m in self.heard][-12:]}, {self.said()[-3:]}"
            try:
                self._hear(self._socket.recv(timeout=min(left, 1.0)))
            except TimeoutError:
                continue

    def picture(self, least: int = 3, after: int = 0) -> np.ndarray:
        """The next picture behind the scene that is wider than `least` pixels: (H, W, 3) uint8."""

        def wide(message: dict[str, Any]) -> bool:
            is_picture = message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None
            return is_picture and decoded(message).shape[1] > least

        return decoded(self.wait(wide, after=after))

    def said(self) -> list[str]:
        """All HTML that was heard, the first one first."""
        props = [m.get("props") or m.get("updates") or {} for m in self.heard]
        return [x["content"] for x in props if isinstance(x.get("content"), str)]

    def labels(self) -> list[str]:
        """Of all inputs of the panel."""
        return [m["props"]["label"] for m in self.heard if "label" in (m.get("props") or {})]

    def _hear(self, data: bytes) -> None:
        size = int.from_bytes(data[8:16], "little")
        window = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]))
        at, buffers = 16 + size, []
        for length in window["binaryBufferLengths"]:
            at += -at % 8
            buffers.append(data[at : at + length])
            at += length
        self.heard += [_filled(message, buffers) for message in window["messages"]]


def decoded(message: dict[str, Any]) -> np.ndarray:
    """The picture of a BackgroundImageMessage."""
    return cv2.imdecode(np.frombuffer(bytes(message["rgb_data"]), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def gaussians(message: dict[str, Any]) -> np.ndarray:
    """(N, 8) uint32 of a message with Gaussians."""
    return np.frombuffer(message["props"]["buffer"], np.uint32).reshape(-1, 8)


def _filled(value: Any, buffers: list[bytes]) -> Any:
    if isinstance(value, dict):
        if "__binary_index" in value:
            return buffers[value["__binary_index"]]
        return {name: _filled(x, buffers) for name, x in value.items()}
    return [_filled(x, buffers) for x in value] if isinstance(value, list) else value
