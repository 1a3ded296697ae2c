"""The implicit fit beside ferreus_rbf and scipy, on the same constraints; run by `cargo xtask bench fit`.

    python tests/bench/fit.py FOLDER_OF_OUR_PROGRAMS WORK_FOLDER REPEAT

Every fit is a process of its own, ours and the peer's by turns; CPU time (user and system, all threads) and peak memory are
those of the whole process with its reading and writing; medians. The true residual is a plain double sum of a third
program. Both are asked for 1e-6 mm; the peer's tolerance bounds a 2-norm, so that it is given ten times as much where it
then still comes to 1e-6. Ends with an error where a bar is missed.
"""

import os
import pathlib
import re
import statistics
import subprocess
import sys
import time

import numpy as np

WANTED_MM = 1e-6
# A uniform smoothing that both programs know, in scaled units: wall points that err by some hundredths of a millimetre.
NOISE = "1e-8"
# Constraints: how many times as fast as the peer, in CPU time.
TIMES_AS_FAST = {5_000: 2.5, 10_000: 2.5, 20_000: 3.0, 50_000: 1.5}
LARGE, LARGE_CPU_S = 100_000, 120.0
PEER_LIMIT_S = 900
BYTES_PER_UNKNOWN = 5_000
ORACLE, ORACLE_OFF = (1_000, 2_000, 5_000), 1e-6
SHARE_OF_ROOTS = 0.8
SCIPY = 5_000
# Beyond this, one run of each: their CPU time varies by less than the bars' margin.
OFTEN = 20_000

SCIPY_FIT = """
import re, sys, numpy as np
from scipy.interpolate import RBFInterpolator
rows = np.fromfile(sys.argv[1]).reshape(-1, 4)
fitted = RBFInterpolator(rows[:, :3], rows[:, 3], kernel="cubic", degree=1, smoothing=float(sys.argv[3]))
np.ravel(fitted._coeffs)[: len(rows)].tofile(sys.argv[2])
print("peak", 1024 * int(re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read()).group(1)))
"""


class Run:
    """A process that has ended: CPU seconds, what it said, peak memory in bytes where it said that; `late` where it was stopped at
    its limit, `ok` where it ended by itself and well."""

    def __init__(self, command, limit_s=None):
        child = subprocess.Popen([str(c) for c in command], stdout=subprocess.PIPE, text=True)
        begin, self.late = time.monotonic(), False
        while True:
            pid, status, usage = os.wait4(child.pid, os.WNOHANG)
            if pid:
                break
            if limit_s and time.monotonic() - begin > limit_s:
                self.late = True
                child.kill()
            time.sleep(0.002)
        child.returncode = os.waitstatus_to_exitcode(status)
        self.ok = child.returncode == 0
        self.said = child.stdout.read()
        self.cpu_s = usage.ru_utime + usage.ru_stime
        self.bytes = number("peak", self.said) if "peak" in self.said else None


def number(name, text):
    return float(re.search(rf"{name} (\S+)", text).group(1))


class Bench:
    def __init__(self, programs, work, repeat):
        self.ours, self.peer = programs / "bench-fit", programs / "bench-fit-peer"
        self.work, self.repeat, self.bars = work, repeat, []
        # asked of the peer: the loose one until a case does not come to the residual wanted with it, as larger ones then won't
        self.peer_tolerance = 10 * WANTED_MM

    def bar(self, what, kept):
        self.bars.append((what, kept))

    def constraints(self, n):
        file = self.work / f"constraints-{n}.f64"
        subprocess.run([self.ours, "make", str(n), file], check=True)
        return file

    def residual(self, file, coefficients):
        run = Run([self.ours, "residual", file, coefficients, NOISE])
        return number("residual", run.said) if run.ok else float("inf")

    def fit(self, file, who, tolerance):
        out = self.work / who
        program = [self.peer] if who == "theirs" else [self.ours, who]
        run = Run([*program, file, out, f"{tolerance:e}", NOISE], PEER_LIMIT_S if who == "theirs" else None)
        if not run.ok and not run.late:
            raise SystemExit(f"{program[0].name} failed on {file.name}")
        return run, out

    def tolerance_of_peer(self, file):
        """The loosest of two tolerances that brings the peer to the residual wanted; the stricter where neither does."""
        if self.peer_tolerance > WANTED_MM:
            run, out = self.fit(file, "theirs", self.peer_tolerance)
            if not run.ok or self.residual(file, out) > WANTED_MM:
                self.peer_tolerance = WANTED_MM
        return self.peer_tolerance

    def case(self, n):
        file = self.constraints(n)
        with_peer = n in TIMES_AS_FAST
        tolerance = self.tolerance_of_peer(file) if with_peer else None
        idle = Run([self.ours, "idle", file])
        runs = {"ours": [], "theirs": []}
        for _ in range(self.repeat if n <= OFTEN else 1):
            runs["ours"].append(self.fit(file, "ours", WANTED_MM)[0])
            if with_peer:
                runs["theirs"].append(self.fit(file, "theirs", tolerance)[0])
        left = self.residual(file, self.work / "ours")
        cpu = statistics.median(r.cpu_s for r in runs["ours"])
        memory = (max(r.bytes for r in runs["ours"]) - idle.bytes) / n
        iterations = int(number("iterations", runs["ours"][0].said))
        row = f"{n:>8}{cpu:>9.2f}{iterations:>5}{left:>9.1e}{memory / 1e3:>8.2f}"
        self.bar(f"{n}: true residual {left:.1e} mm, at most {WANTED_MM:.0e}", left <= WANTED_MM)
        self.bar(f"{n}: {memory / 1e3:.2f} kB per unknown, at most {BYTES_PER_UNKNOWN / 1e3:.0f}", memory <= BYTES_PER_UNKNOWN)
        if with_peer:
            row += self.beside(n, file, runs, tolerance, idle.bytes)
        if n == LARGE:
            self.bar(f"{n}: {cpu:.0f} CPU-s, at most {LARGE_CPU_S:.0f}", cpu <= LARGE_CPU_S)
        if n == SCIPY:
            self.scipy(file, cpu)
        print(row, flush=True)
        file.unlink()

    def beside(self, n, file, runs, tolerance, idle):
        theirs = runs["theirs"]
        cpu = statistics.median(r.cpu_s for r in theirs)
        # of a run that was stopped at its limit the time until then: the ratio is then a lower bound
        ratio = statistics.median(t.cpu_s / o.cpu_s for o, t in zip(runs["ours"], theirs))
        self.bar(f"{n}: {ratio:.2f} times as fast as ferreus_rbf, at least {TIMES_AS_FAST[n]}", ratio >= TIMES_AS_FAST[n])
        if not all(r.ok for r in theirs):
            return f"  did not end within {PEER_LIMIT_S} s"
        left = self.residual(file, self.work / "theirs")
        memory = (max(r.bytes for r in theirs) - idle) / n
        return f"{cpu:>10.2f}{tolerance:>9.0e}{left:>9.1e}{memory / 1e3:>8.2f}{ratio:>8.2f}"

    def scipy(self, file, cpu):
        out = self.work / "scipy"
        run = Run([sys.executable, "-c", SCIPY_FIT, file, out, NOISE])
        if not run.ok:
            print(f"scipy: failed on {file.name}")
            return
        print(
            f"scipy {SCIPY}: {run.cpu_s:.2f} CPU-s with the interpreter, residual {self.residual(file, out):.1e} mm,"
            f" {run.bytes / 1e6:.0f} MB; ours is {run.cpu_s / cpu:.1f} times as fast"
        )

    def oracle(self):
        """Coefficients of conjugate gradients, solved as far as the second pass of a fit is, against the dense factor's."""
        for n in ORACLE:
            file = self.constraints(n)
            dense = np.fromfile(self.fit(file, "dense", WANTED_MM)[1])
            found = np.fromfile(self.fit(file, "ours", 1e-9)[1])
            off = np.linalg.norm(found - dense) / np.linalg.norm(dense)
            self.bar(f"{n}: coefficients differ from the dense factor's by {off:.1e}, at most {ORACLE_OFF:.0e}", off <= ORACLE_OFF)

    def rates(self):
        file = self.constraints(5_000)
        said = Run([self.ours, "rates", file]).said
        shares = [float(s) for s in re.search(r"shares (\S+) (\S+)", said).groups()]
        rate = {name: number(name, said) / 1e9 for name in ("roots", "value", "gradient")}
        print(f"1e9 per second on one thread: square roots {rate['roots']:.2f}, pairs of f {rate['value']:.2f}, of f with gradient {rate['gradient']:.2f}")
        for name, share in zip(("f", "f with gradient"), shares):
            self.bar(f"sums of {name} run at {100 * share:.0f} % of the rate of square roots, at least {100 * SHARE_OF_ROOTS:.0f}", share >= SHARE_OF_ROOTS)


def main():
    programs, work, repeat = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), int(sys.argv[3])
    work.mkdir(parents=True, exist_ok=True)
    bench = Bench(programs, work, repeat)
    bench.rates()
    bench.oracle()
    print(f"{'':>8}{'ours':>40}{'ferreus_rbf':>44}")
    print(f"{'n':>8}{'CPU s':>9}{'it':>5}{'residual':>9}{'kB/n':>8}{'CPU s':>10}{'asked':>9}{'residual':>9}{'kB/n':>8}{'times':>8}")
    for n in (1_000, 2_000, *TIMES_AS_FAST, LARGE):
        bench.case(n)
    for what, kept in bench.bars:
        print(f"{'kept  ' if kept else 'MISSED'} {what}")
    if not all(kept for _, kept in bench.bars):
        raise SystemExit("a bar was missed")


if __name__ == "__main__":
    main()
