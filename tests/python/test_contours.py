"""Our smoothing beside SciPy's splprep at its best smoothing, on the same raw contours.

    VASCULUM_ROOT=FOLDER python tests/python/test_contours.py

The raw contours come from the example `judged` of the crate `imaging`. For every case splprep is given the smoothing that
suits the truth best (which no user can know), with and without the half-maximum correction. Needs numpy and scipy.
"""

import os
import pathlib
import subprocess

import numpy as np
from scipy.interpolate import splev, splprep

ROOT = pathlib.Path(os.environ.get("VASCULUM_ROOT", pathlib.Path(__file__).parents[2]))
BARS = {
    ("disc", 5.0): {10: 0.138, 20: 0.060, 30: 0.045},
    ("disc", 7.5): {10: 0.115, 20: 0.052, 30: 0.033},
    ("disc", 10.0): {10: 0.105, 20: 0.045, 30: 0.036},
    ("peanut", 5.0): {20: 0.080},
    ("peanut", 7.5): {20: 0.072},
    ("peanut", 10.0): {20: 0.068},
}
BLUR = 0.6**2 + 1 / 12


def distance(shape, radius, turn, p):
    if shape == "disc":
        return np.hypot(*p.T) - radius
    along = 0.5 * radius * np.array([np.cos(turn), np.sin(turn)])
    a, b = (np.hypot(*(p - s * along).T) - 0.6 * radius for s in (1, -1))
    k = 0.4 * radius
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - k * h**3 / 6


def fitpack(raw, s):
    closed = np.vstack([raw, raw[:1]])
    tck, _ = splprep(closed.T, s=s, per=1)
    u = np.linspace(0, 1, 200, endpoint=False)
    p, d, dd = (np.array(splev(u, tck, der=k)).T for k in range(3))
    speed = np.hypot(*d.T)
    kappa = (d[:, 0] * dd[:, 1] - d[:, 1] * dd[:, 0]) / speed**3
    outward = np.stack([d[:, 1], -d[:, 0]], 1) / speed[:, None]
    return p, p + (0.5 * BLUR * np.clip(kappa, -1, 1))[:, None] * outward


def read():
    built = os.environ.get("VASCULUM_JUDGED")
    command = [built] if built else ["cargo", "run", "--quiet", "-p", "imaging", "--example", "judged"]
    text = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    cases = {}
    for line in text.splitlines():
        shape, radius, snr, _, x, y, turn, raw, ours = line.split()
        points = [np.array([q.split(",") for q in c.split(";")], float) - [float(x), float(y)] for c in (raw, ours)]
        cases.setdefault((shape, float(radius), int(float(snr))), []).append((float(turn), *points))
    return cases


def main():
    print("shape radius SNR: ours, splprep at its best, the same corrected, bar (rms px)")
    faults = []
    for (shape, radius, snr), curves in read().items():
        assert len(curves) == 20, f"{shape} {radius} {snr}: {len(curves)} contours of 20"
        ours = np.sqrt(np.mean([np.mean(distance(shape, radius, t, o) ** 2) for t, _, o in curves]))
        best = [np.inf, np.inf]
        for share in np.geomspace(0.05, 4, 24):
            s2 = 1.2 * (0.6 * np.sqrt(2 * np.pi) / snr) ** 2
            fits = [fitpack(raw, share * len(raw) * s2) for _, raw, _ in curves]
            for k in range(2):
                off = [np.mean(distance(shape, radius, c[0], f[k]) ** 2) for c, f in zip(curves, fits)]
                best[k] = min(best[k], np.sqrt(np.mean(off)))
        bar = BARS[shape, radius][snr]
        print(f"{shape:6} {radius:4} {snr:3}: {ours:.4f}  {best[0]:.4f}  {best[1]:.4f}  {bar}")
        if ours > bar:
            faults.append(f"{shape} {radius} at SNR {snr}: {ours:.4f} over the bar {bar}")
        if ours > best[0]:
            faults.append(f"{shape} {radius} at SNR {snr}: {ours:.4f}, splprep {best[0]:.4f}")
    assert not faults, "\n".join(faults)


if __name__ == "__main__":
    main()
