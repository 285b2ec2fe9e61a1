"""Paint for rooms: plaster, wood, cloth, spines of books, pictures, and what is seen through a window.

All are float32 sRGB in [0, 255], (height, width, 3), drawn by a generator `rng`, so that a seed repeats them.
"""

from __future__ import annotations

import numpy as np

from drgs.scenes import mix, noise, ramp

__all__ = ["art", "cloth", "leaf", "outdoors", "panel", "planks", "plaster", "rug", "spines", "wood"]


def plaster(rng, color, kind, height=320, width=640):
    """A wall of one color: plain, striped, or papered with rings; uneven as plaster is."""
    color = np.asarray(color, np.float32)
    out = ramp(noise(rng, height, width, 10, 5), 0.88 * color, 1.05 * color)
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    if kind == "stripes":
        out = mix(out, 0.80 * color + 12, 0.8 * ((x // 20) % 2))
        out[(x % 40) < 2] = 0.62 * color
    elif kind == "rings":
        cell = 40
        u = (x + cell // 2 * ((y // cell) % 2)) % cell - cell / 2
        v = y % cell - cell / 2
        radius = np.hypot(u, v)
        out[np.abs(radius - 13) < 2.2] = 0.66 * color
        out[radius < 4.5] = 0.5 * color + (70, 50, 10)
    return out


def planks(rng, colors, boards=10, size=640):
    """A floor of boards along y, each with its tone, ends that do not line up, and grain."""
    x = np.linspace(0, boards, size, endpoint=False)
    board = x.astype(int)
    y = np.linspace(0, 1, size, endpoint=False)[:, None]
    along = y * 2 + rng.random(boards)[board][None]
    tone = rng.uniform(-0.22, 0.22, (boards, 4))[board[None], along.astype(int) % 4]
    grain = 0.9 * (noise(rng, size, size, 3, 6, stretch=14.0).T - 0.5)
    out = ramp(np.clip(0.5 + grain + tone, 0, 1), *colors)
    seam = (np.abs(x - np.round(x)) < 0.025)[None] | (along % 1 < 0.006)
    out[seam] *= 0.55
    return out


def wood(rng, dark, light, size=320):
    """Grain along x."""
    grain = noise(rng, size, size, 3, 6, stretch=16.0)
    rings = 0.5 + 0.5 * np.sin(18 * noise(rng, size, size, 2, 2, stretch=6.0))
    return ramp(0.65 * grain + 0.35 * rings, dark, light)


def cloth(rng, color, kind="plain", accent=(240, 232, 214), size=320):
    """Woven cloth: plain, stripes, checks, dots or zigzag."""
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    color = np.asarray(color, np.float32)
    out = ramp(noise(rng, size, size, 40, 4), 0.78 * color, 1.12 * color)
    mask = np.zeros((size, size))
    if kind == "stripes":
        mask = ((x // 26) % 3 == 0) * 1.0
    elif kind == "checks":
        mask = 0.5 * ((x // 32) % 2) + 0.5 * ((y // 32) % 2)
    elif kind == "dots":
        mask = (np.hypot(x % 54 - 27, y % 54 - 27) < 13) * 1.0
    elif kind == "zigzag":
        mask = ((y + np.abs(x % 64 - 32)) // 20 % 2) * 1.0
    return mix(out, accent, 0.85 * mask) * (0.95 + 0.05 * np.sin(0.9 * x) * np.sin(0.9 * y))[..., None]


def rug(rng, base, second, third, height=512, width=768):
    """A border, a field of diamonds, and a medallion in the middle."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    out = ramp(noise(rng, height, width, 60, 3), 0.8 * np.asarray(base), 1.1 * np.asarray(base))
    diamond = np.abs(x % 64 - 32) + np.abs(y % 64 - 32)
    out[(diamond < 30) & (diamond > 18)] = second
    out[diamond < 10] = third
    middle = np.hypot((x - width / 2) / 1.4, y - height / 2)
    petals = 110 + 22 * np.cos(8 * np.arctan2(y - height / 2, (x - width / 2) / 1.4))
    for part, color in ((1.0, second), (0.88, base), (0.6, third), (0.5, second), (0.25, base)):
        out[middle < part * petals] = color
    edge = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y))
    for far, color in ((64, third), (56, second), (46, base), (14, second), (8, third)):
        out[edge < far] = color
    out[(edge < 46) & (edge > 14) & ((x + y) % 48 < 16)] = third
    return out * (0.9 + 0.2 * noise(rng, height, width, 90, 2))[..., None]


def spines(rng, count=64, height=256, each=32):
    """Spines of books side by side: a color, two bands and a title each."""
    palette = ((150, 40, 36), (34, 66, 112), (42, 92, 62), (206, 160, 70), (226, 214, 186), (70, 44, 80), (46, 46, 50))
    out = np.zeros((height, count * each, 3), np.float32)
    for k in range(count):
        color = np.asarray(palette[rng.integers(len(palette))]) + rng.uniform(-16, 16, 3)
        ink = (40, 30, 26) if color.sum() > 380 else (226, 200, 140)
        column = out[:, k * each : (k + 1) * each]
        column[:] = color
        for y in rng.uniform((0.08, 0.85), (0.14, 0.92)):
            column[int(y * height) : int(y * height) + 8] = ink
        top, long = rng.uniform((0.22, 0.25), (0.34, 0.45))
        column[int(top * height) : int((top + long) * height), 11:21] = ink
        column[:, :2] *= 0.5
    return out


def art(rng, kind, height=256, width=320):
    """A painting (height, width, 3) by the name of its kind: hills (under a sun), shapes, or flower (seven of them)."""
    import cv2

    y = np.linspace(0, 1, height)[:, None].repeat(width, 1)
    if kind == "hills":
        out = ramp(y, rng.integers(60, 150, 3), rng.integers(160, 240, 3), (250, 216, 150))
        cv2.circle(out, (int(rng.integers(60, width - 60)), int(0.4 * height)), 26, (250, 232, 170), -1, cv2.LINE_AA)
        for layer in range(4):
            wave = np.sin(np.arange(width) / rng.uniform(18, 46) + rng.uniform(0, 6))
            tone = rng.integers((20, 50, 40), (110, 130, 110)) * (1.2 - 0.2 * layer)
            out[np.arange(height)[:, None] > height * (0.48 + 0.13 * layer) + 16 * wave] = tone
    elif kind == "shapes":
        out = ramp(noise(rng, height, width, 6), (214, 200, 172), (240, 230, 208))
        for color in ((190, 60, 46), (34, 70, 120), (232, 178, 60), (40, 44, 48), (64, 128, 110)) * 2:
            at = rng.integers((20, 20), (width - 20, height - 20))
            size = rng.integers(16, 56, 2)
            if rng.random() < 0.5:
                cv2.ellipse(out, at.tolist(), size.tolist(), float(rng.uniform(0, 180)), 0, 360, color, -1, cv2.LINE_AA)
            else:
                cv2.rectangle(out, (at - size).tolist(), (at + size).tolist(), color, -1)
    else:
        out = ramp(noise(rng, height, width, 5), (40, 58, 66), (74, 98, 100))
        for _ in range(7):
            at = rng.integers((50, 40), (width - 50, height - 60))
            tone = rng.integers((170, 70, 60), (250, 190, 150))
            cv2.line(out, at.tolist(), (width // 2, height), (60, 110, 64), 4, cv2.LINE_AA)
            for angle in range(0, 360, 45):
                tip = at + 20 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
                cv2.ellipse(out, tip.astype(int).tolist(), (18, 9), angle, 0, 360, tone.tolist(), -1, cv2.LINE_AA)
            cv2.circle(out, at.tolist(), 10, (240, 206, 90), -1, cv2.LINE_AA)
    return out * (0.93 + 0.14 * noise(rng, height, width, 60, 3))[..., None]


def panel(rng, color, height=640, width=288):
    """A door: six panels with a bright and a dark edge each."""
    import cv2

    color = np.asarray(color, np.float32)
    out = ramp(noise(rng, height, width, 4, 5, stretch=0.15), 0.9 * color, 1.04 * color)
    for x0 in (34, 158):
        for y0, y1 in ((36, 176), (214, 400), (438, 602)):
            cv2.rectangle(out, (x0, y0), (x0 + 96, y1), (0.55 * color).tolist(), 7)
            cv2.rectangle(out, (x0 + 8, y0 + 8), (x0 + 88, y1 - 8), (1.12 * color).tolist(), 4)
    return out


def leaf(rng, size=128):
    """Veins on a leaf, along y."""
    u, v = np.meshgrid(np.linspace(-1, 1, size), np.linspace(0, 60, size))
    veins = np.clip(0.3 + 0.6 * u**2 + 0.15 * np.sin(v + 6 * np.abs(u)), 0, 1)
    return ramp(veins, (150, 182, 92), (74, 128, 58), (38, 90, 44)) * rng.uniform(0.85, 1.1)


def outdoors(rng, height=256, width=320):
    """Sky, clouds, trees, a house and a lawn."""
    import cv2

    y = np.linspace(0, 1, height)[:, None].repeat(width, 1)
    out = ramp(y, (128, 176, 232), (190, 216, 240), (232, 236, 232))
    out = mix(out, (250, 250, 250), np.clip(2.2 * noise(rng, height, width, 5, 5, stretch=2.0) - 1.1, 0, 1))
    x = int(rng.integers(60, width - 130))
    cv2.rectangle(out, (x, 118), (x + 96, 190), (206, 178, 142), -1)
    cv2.fillPoly(out, [np.array([(x - 12, 120), (x + 48, 78), (x + 108, 120)])], (150, 74, 58))
    for dx in (14, 58):
        cv2.rectangle(out, (x + dx, 136), (x + dx + 22, 162), (70, 84, 98), -1)
    for _ in range(26):
        at = rng.integers((0, 118), (width, 180))
        r = int(rng.integers(12, 28))
        cv2.circle(out, at.tolist(), r, (rng.integers((60, 104, 48), (110, 150, 80))).tolist(), -1, cv2.LINE_AA)
    lawn = ramp(noise(rng, height, width, 40), (104, 142, 66), (146, 178, 92))
    out[184:] = lawn[184:]
    return out
