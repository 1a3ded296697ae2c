"""Thinning of one volume by ours, gaara and scikit-image, interleaved; run by `cargo xtask bench thinning`.

    python tests/bench/thinning.py PATH_TO_OUR_EXAMPLE WORK_FOLDER REPEAT

Only the thinning itself is timed, on an array in memory, one and two threads where the program has them (scikit-image
has none and runs once at 512^3, where it takes a minute). gaara is timed on an array in C order, numpy's default, and in
Fortran order, which suits it better. Medians of wall time; the ratios are of the CPU time on one
thread, which a busy machine changes least, and of the wall time on two.
"""

import pathlib
import statistics
import subprocess
import sys
import time

import gaara
import numpy as np
from skimage.morphology import skeletonize

SIZES = (128, 256, 512)


def ours(program, n, path, threads):
    run = [program, "run", str(n), str(path), str(threads)]
    return [float(x) for x in subprocess.run(run, check=True, capture_output=True, text=True).stdout.split()]


def timed(work):
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def measured(program, n, path, repeat):
    """(wall, CPU) seconds of every run by program and threads, then voxels before, after, bytes of memory."""
    volume = np.fromfile(path, dtype=np.uint8).reshape((n, n, n), order="F")
    binary, rows = volume > 0, np.ascontiguousarray(volume)
    runs = {name: [] for name in ("ours 1", "ours 2", "gaara C 1", "gaara F 1", "gaara F 2", "scikit-image")}
    grown = []
    for k in range(repeat):
        for threads in (1, 2):
            wall, cpu, before, after, memory = ours(program, n, path, threads)
            runs[f"ours {threads}"].append((wall, cpu))
            grown.append(memory)
            runs[f"gaara F {threads}"].append(timed(lambda: gaara.thin(volume, binary_image=True, threads=threads)))
        runs["gaara C 1"].append(timed(lambda: gaara.thin(rows, binary_image=True)))
        if n < 512 or k == 0:
            runs["scikit-image"].append(timed(lambda: skeletonize(binary, method="lee")))
    return runs, (int(before), int(after), max(grown))


def main():
    program, work, repeat = sys.argv[1], pathlib.Path(sys.argv[2]), int(sys.argv[3])
    work.mkdir(parents=True, exist_ok=True)
    for n in SIZES:
        path = work / f"bifurcation-{n}.raw"
        subprocess.run([program, "make", str(n), str(path)], check=True)
        runs, (before, after, grown) = measured(program, n, path, repeat)
        wall = {name: statistics.median(r[0] for r in times) for name, times in runs.items()}
        cpu = {name: statistics.median(r[1] for r in times) for name, times in runs.items()}
        print(f"{n}^3, {before} voxels, {after} left, {grown / 2**20:.1f} MiB beyond the input")
        for name in runs:
            print(f"  {name:<14} wall {wall[name]:8.4f} s  CPU {cpu[name]:8.4f} s")
        print(
            f"  times as fast as gaara {cpu['gaara C 1'] / cpu['ours 1']:.1f} (C order),"
            f" {cpu['gaara F 1'] / cpu['ours 1']:.1f} (Fortran order; two threads, wall"
            f" {wall['gaara F 2'] / wall['ours 2']:.1f}), as scikit-image {cpu['scikit-image'] / cpu['ours 1']:.0f}",
            flush=True,
        )
        path.unlink()


if __name__ == "__main__":
    main()
