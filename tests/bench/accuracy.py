"""Ours and VMTK 1.5.2 on the same simulated scans, against the exact truth, interleaved; run by `cargo xtask bench accuracy`.

    python tests/bench/accuracy.py PATH_TO_VASCULUM WORK_FOLDER SEEDS

The anastomosis with seeds 1 to SEEDS in two resolutions. Each scan is made, reconstructed by ours, then by VMTK's chain
(tests/bench/vmtk_chain.py: what VMTK is given there, ours finds by itself, but for the names of the three branches). VMTK's
chain runs once for each end as the inlet; the best and the worst inlet are chosen for each scan by the worst of the
three angles, which a user without the truth could not do. Then VMTK's centrelines on our closed surfaces: whether it takes them,
and its bifurcation vectors beside `vmtk` in result.json.
"""

import json
import pathlib
import subprocess
import sys

import numpy as np

CHAIN = pathlib.Path(__file__).with_name("vmtk_chain.py")
RESOLUTIONS = {
    ".5 x .5 x 1.5 mm, SNR 20": ["--pixel", ".5", "--spacing", "1.5", "--slices", "44", "--size", "256", "--snr", "20"],
    ".7 x .7 x 3 mm, SNR 10": ["--pixel", ".7", "--spacing", "3", "--slices", "22", "--size", "184", "--snr", "10"],
}
ANGLES = ("graft_proximal", "graft_distal_planar", "distal_normal")
ROLES = ("proximal", "distal", "graft")


def loaded(path):
    return json.loads(path.read_text())


def quietly(*command):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    return None if done.returncode == 0 else f"{command[1]} ended with {done.returncode}: {done.stderr.strip()[-300:]}"


def chain(what, path, truth, out):
    """VMTK in a process of its own: it may end with a signal."""
    why = quietly(sys.executable, CHAIN, what, path, truth, out)
    return loaded(out) if why is None else {"stages": {}, "inlets": {r: {"why": why} for r in ROLES}}


def ours(folder, truth):
    """The same figures as VMTK's, from result.json."""
    told, times = loaded(folder / "result.json"), loaded(folder / "provenance.json")
    junction = told["junctions"][0]
    result = {"angles": {a["name"]: a["value"] for a in junction["angles"]}}
    result |= {"radius": {}, "radius_area": {}, "areas": {}, "centreline_rms_mm": [], "stages": times["stages"], "whole": times}
    for branch in told["branches"]:
        true = next(b for b in truth["branches"] if b["role"] == branch["role"])
        sample = {k: np.array(v, float) for k, v in branch["samples"].items() if v}
        x = sample["position"].reshape(-1, 3) - np.array(truth["junction"]["axes_point"])
        along = x @ np.array(true["direction"])
        off = np.linalg.norm(x - along[:, None] * np.array(true["direction"]), axis=1)
        clear = (along > true["circular_from_mm"]) & (along < true["length_mm"] - true["radius_mm"]) & (sample["open"] == 0)
        result["radius"][branch["role"]] = np.median(sample["radius_inscribed_mm"][clear]) / true["radius_mm"] - 1
        result["radius_area"][branch["role"]] = np.median(sample["radius_area_mm"][clear]) / true["radius_mm"] - 1
        result["areas"][branch["role"]] = np.mean(sample["area_mm2"][clear]) / true["area_mm2"] - 1
        result["centreline_rms_mm"].append(np.sqrt((off[clear] ** 2).mean()))
    return result


def readings(binary, work, inlets):
    """`vmtk` of result.json for these inlets: the inlet is the branch called proximal, so the names take turns."""
    plan, found = loaded(work / "scan/plan.json"), {}
    for inlet in inlets:
        swapped = {**dict(zip(ROLES, ROLES)), "proximal": inlet, inlet: "proximal"}
        folder = work / "out"
        if inlet != "proximal":
            folder = work / f"out-{inlet}"
            roles = {f"{r}_mm": plan["roles"][f"{swapped[r]}_mm"] for r in ROLES}
            (work / "turned.json").write_text(json.dumps(plan | {"roles": roles}))
            why = quietly(binary, "run", work / "scan/dicom", "--plan", work / "turned.json", "--out", folder)
            if why:
                raise SystemExit(why)
        told = loaded(folder / "result.json")
        role = {b["id"]: swapped[b["role"]] for b in told["branches"]}
        junction = told["junctions"][0]
        names = [role[b] for b in junction["branches"]]
        assert role[junction["vmtk"]["inlet"]] == inlet
        found[inlet] = {k: dict(zip(names, junction["vmtk"][k])) for k in ("in_plane", "out_of_plane")}
    return found


def errors(angles, truth):
    return {a: abs(angles[a] - truth["angles"][a]) for a in ANGLES}


def one(binary, work, seed, options):
    """A scan through both chains, one after the other."""
    scan, out = work / "scan", work / "out"
    for step in (
        [binary, "phantom", "anastomosis", "--seed", seed, *options, "--out", scan],
        [binary, "run", scan / "dicom", "--plan", scan / "plan.json", "--out", out],
    ):
        why = quietly(*step)
        if why:
            raise SystemExit(why)
    truth = loaded(scan / "truth.json")
    return {
        "seed": seed,
        "truth": truth,
        "ours": ours(out, truth),
        "readings": readings(binary, work, ROLES if seed == 1 else ROLES[:1]),
        "vmtk": chain("scan", scan / "scan.nii", scan / "truth.json", work / "chain.json"),
        "surface": chain("surface", out / "surface.vtp", scan / "truth.json", work / "surface.json"),
        "extended": chain("surface", out / "surface_extended.vtp", scan / "truth.json", work / "extended.json"),
    }


def figures(told, truth):
    """Numbers of one result by quantity; infinite where there is no result."""
    if told.get("why"):
        return None
    e = errors(told["angles"], truth)
    row = {"worst of the three angles, deg": [max(e.values())]} | {f"  {a}": [e[a]] for a in ANGLES}
    row["area, %"] = [100 * v for v in told["areas"].values() if v is not None]
    row["inscribed radius, %"] = [100 * v for v in told["radius"].values()]
    row["centreline rms, mm"] = told["centreline_rms_mm"]
    return row


def best_and_worst(inlets, truth):
    """The results of the inlets with the least and the largest worst angle; one without a result is the worst."""
    def size(told):
        return np.inf if told.get("why") else max(errors(told["angles"], truth).values())

    order = sorted(inlets.values(), key=size)
    return order[0], order[-1]


def table(scans):
    columns = {"ours": [s["ours"] for s in scans]}
    pairs = [best_and_worst(s["vmtk"]["inlets"], s["truth"]) for s in scans]
    columns |= {"VMTK, best inlet": [p[0] for p in pairs], "VMTK, worst inlet": [p[1] for p in pairs]}
    rows = {name: [figures(t, s["truth"]) for t, s in zip(told, scans)] for name, told in columns.items()}
    print(f"{'median / 95th percentile of |error| (mean)':<44}" + "".join(f"{name:>30}" for name in columns))
    for quantity in figures(scans[0]["ours"], scans[0]["truth"]):
        cells = []
        for got in rows.values():
            values = np.array([v for row in got if row for v in row[quantity]])
            none = sum(row is None for row in got)
            if not len(values):
                cells.append("none")
                continue
            size, bias = abs(values), "" if "deg" in quantity or "_" in quantity or "rms" in quantity else f" ({values.mean():+.2f})"
            missing = f" [{none} without]" if none else ""
            cells.append(f"{np.median(size):.3f} / {np.percentile(size, 95):.3f}{bias}{missing}")
        print(f"{quantity:<44}" + "".join(f"{c:>30}" for c in cells))
    vectors = [errors(t["vectors"]["angles"], s["truth"]) for s in scans for t in s["vmtk"]["inlets"].values() if "angles" in t.get("vectors", {})]
    if vectors:
        worst = [max(v.values()) for v in vectors]
        print(f"by VMTK's bifurcation vectors the worst of the three errs by {np.median(worst):.0f} degrees (median), {max(worst):.0f} (most)")
    reasons = [f"seed {s['seed']}, {r}: {t['why']}" for s in scans for r, t in s["vmtk"]["inlets"].items() if t.get("why")]
    print(f"VMTK's centrelines wrong or missing: {len(reasons)} of {3 * len(scans)}", *reasons, sep="\n  ")


def median(values):
    return float(np.median(list(values))) if values else float("nan")


def times(scans):
    """Both chains stage by stage; VMTK's with one inlet, the median of the three."""
    print(f"{'stage':<36}{'wall s':>9}{'CPU s':>9}")
    for k, stage in enumerate(scans[0]["ours"]["stages"]):
        wall, cpu = (median([s["ours"]["stages"][k][n] for s in scans]) for n in ("wall_s", "cpu_s"))
        print(f"{'ours: ' + stage['stage']:<36}{wall:>9.2f}{cpu:>9.2f}")
    whole = {n: median([s["ours"]["whole"][n] for s in scans]) for n in ("wall_s", "cpu_s")}
    print(f"{'ours: whole':<36}{whole['wall_s']:>9.2f}{whole['cpu_s']:>9.2f}")
    sums = {"wall_s": 0.0, "cpu_s": 0.0}
    for name in ("surface", "remesh", "centreline", "branches and vectors", "sections"):
        of_scan = [s["vmtk"]["stages"][name] for s in scans if name in s["vmtk"]["stages"]]
        of_inlet = [t["stages"][name] for s in scans for t in s["vmtk"]["inlets"].values() if name in t.get("stages", {})]
        both = {n: median([t[n] for t in of_scan or of_inlet]) for n in sums}
        sums = {n: sums[n] + both[n] for n in sums}
        print(f"{'VMTK: ' + name:<36}{both['wall_s']:>9.2f}{both['cpu_s']:>9.2f}")
    print(f"{'VMTK: whole':<36}{sums['wall_s']:>9.2f}{sums['cpu_s']:>9.2f}")
    print(f"{'VMTK / ours':<36}{sums['wall_s'] / whole['wall_s']:>9.2f}{sums['cpu_s'] / whole['cpu_s']:>9.2f}")


def on_our_surface(scans):
    """Whether VMTK takes our surfaces, and its vectors beside our reading of them."""
    for name in ("surface", "extended"):
        taken = [t for s in scans for t in s[name]["inlets"].values()]
        why = [f"seed {s['seed']}, inlet {r}: {t['why']} {t.get('said', '')}" for s in scans for r, t in s[name]["inlets"].items() if t.get("why")]
        print(f"VMTK's centrelines on our {name}: right in {len(taken) - len(why)} of {len(taken)}", *why, sep="\n  ")
    differences = []
    for s in scans:
        for role, told in s["surface"]["inlets"].items():
            theirs, own = told.get("vectors", {}), s["readings"].get(role)
            if "in_plane" not in theirs or own is None:
                continue
            for name, angle in (("VMTK", theirs), ("ours", own)):
                shown = "  ".join(f"{r} {angle['in_plane'][r]:+.1f} / {angle['out_of_plane'][r]:+.1f}" for r in ROLES)
                print(f"seed {s['seed']} inlet {role:<9} {name}, in / out of plane: {shown}")
            # The side of the plane's normal depends on the order in which the outlets are named.
            turned = [[abs(side * own[k][r] - theirs[k][r]) for k in own for r in ROLES] for side in (1, -1)]
            differences += min(turned, key=max)
    if differences:
        print(f"our reading of VMTK's angles differs by {np.median(differences):.2f} (median), {max(differences):.2f} degrees (most)")


def main():
    binary, work, seeds = sys.argv[1], pathlib.Path(sys.argv[2]), int(sys.argv[3])
    results = {name: [] for name in RESOLUTIONS}
    for seed in range(1, seeds + 1):
        for k, (name, options) in enumerate(RESOLUTIONS.items()):
            folder = work / f"{k}-{seed}"
            subprocess.run(["rm", "-rf", folder], check=True)
            results[name].append(one(binary, folder, seed, options))
            print(f"seed {seed}, {name}: done", file=sys.stderr, flush=True)
    for name, scans in results.items():
        print(f"\n{name}, seeds 1 to {seeds}")
        table(scans)
        times(scans)
        on_our_surface(scans)


if __name__ == "__main__":
    main()
