"""Pictures in which no laser drew a line: print, textures, light and clutter, by name."""

import cv2
import numpy as np

FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_SCRIPT_COMPLEX)


def pictures(seed, shape=(480, 640)):
    """Name → picture of 8 bits, drawn anew for every seed."""
    rng = np.random.default_rng([45, seed])
    height, width = shape
    v, u = np.mgrid[:height, :width].astype(float)

    def noisy(light, sigma=2.0):
        return np.clip(light + rng.normal(0, sigma, shape), 0, 255).astype(np.uint8)

    def letters(level, ground, scale, thick, texts, angle=0.0, font=0):
        ink = np.zeros(shape, np.uint8)
        for k, text in enumerate(texts):
            at = (20, int((40 + 45 * k) * max(scale, 1)))
            cv2.putText(ink, text, at, FONTS[font], scale, 255, thick, cv2.LINE_AA)
        ink = cv2.warpAffine(ink, cv2.getRotationMatrix2D((width / 2, height / 2), angle, 1), (width, height))
        return noisy(ground + (level - ground) * (cv2.GaussianBlur(ink, (0, 0), 0.8) / 255.0))

    def cloth(level, spread, across, along):
        grain = cv2.GaussianBlur(rng.normal(0, 1, shape), (0, 0), sigmaX=across, sigmaY=along)
        return noisy(level + spread * grain / grain.std())

    def strewn(ground, count, draw, blur=0.7):
        light = np.full(shape, float(ground))
        for _ in range(count):
            draw(light, tuple(map(int, rng.integers(0, [width, height]))), float(rng.integers(90, 240)))
        return noisy(cv2.GaussianBlur(light, (0, 0), blur))

    def anywhere():
        return tuple(map(int, rng.integers(0, [width, height])))

    def ruled(both):
        light = np.full(shape, 50.0)
        light[20::45] = 180
        if both:
            light[:, 20::45] = 180
        return noisy(cv2.GaussianBlur(light, (0, 0), 0.8))

    def marks():
        tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        light, side = np.full(shape, 200.0), height // 5
        for k in range(12):
            y, x = (height // 12 + k // 4 * side * 3 // 2, width // 20 + k % 4 * side * 3 // 2)
            light[y : y + side, x : x + side] = 20 + 180 * (cv2.aruco.generateImageMarker(tags, k, side) / 255.0)
        return noisy(cv2.GaussianBlur(light, (0, 0), 0.8))

    def disc(least, most):
        return lambda p, at, level: cv2.circle(p, at, int(rng.integers(least, most)), level, -1, cv2.LINE_AA)

    def leaf(p, at, level):
        axes = (int(rng.integers(10, 40)), int(rng.integers(4, 12)))
        cv2.ellipse(p, at, axes, float(rng.integers(180)), 0, 360, level, -1, cv2.LINE_AA)

    text = ["benchsim 1:100", "THE QUICK BROWN", "fox jumps over"]
    away = np.hypot(u - width / 2, v - height / 2)
    return {
        "letters": letters(220, 40, 1.5, 3, text),
        "small letters": letters(200, 60, 0.7, 1, text * 3),
        "script": letters(230, 30, 2, 2, ["Laser", "Spiegel"], font=1),
        "watermark": letters(110, 90, 2.5, 4, ["SAMPLE COPY"], angle=30 + rng.uniform(-10, 10)),
        "faint watermark": letters(100, 92, 3, 6, ["DRAFT"], angle=25),
        "large letters": letters(240, 20, 5, 10, ["SO"]),
        "dark letters": letters(20, 220, 1.5, 3, text),
        "gradient": noisy(40 + 150 * u / width),
        "glow": noisy(200 * np.exp(-(away**2) / 2 / (height / 3) ** 2)),
        "vignetting": noisy(220 * np.cos(away / width) ** 4),
        "noise": noisy(np.full(shape, 100.0), 12),
        "grain": cloth(110, 40, 3, 3),
        "clouds": cloth(110, 40, 25, 25),
        "wood": cloth(130, 25, 40, 1),
        "brushed metal": cloth(130, 25, 1.5, 15),
        "checks": noisy(60 + 120 * ((u // 40 + v // 40) % 2)),
        "stripes": noisy(100 + 60 * np.sin(2 * np.pi * u / 24)),
        "slanted stripes": noisy(100 + 60 * np.sin(2 * np.pi * (u + 0.3 * v) / 40)),
        "discs": strewn(60, 60, disc(3, 25)),
        "boxes": strewn(60, 40, lambda p, at, level: cv2.rectangle(p, at, anywhere(), level, -1)),
        "scratches": strewn(40, 25, lambda p, at, level: cv2.line(p, at, anywhere(), level, 2, cv2.LINE_AA)),
        "leaves": strewn(70, 30, leaf, 1.0),
        "stars": strewn(30, 400, disc(1, 2)),
        "squared paper": ruled(True),
        "ruled paper": ruled(False),
        "marks": marks(),
        "lamp": noisy(60 + 180 / (1 + np.exp((away - 60) / 12))),
        "edge": noisy(60 + 120.0 * (u > width / 2 + 0.2 * v)),
    }
