"""The command line as a person meets it: the manual is read by groff, the completions by bash, tables fit 80 columns, and
`show` says what the result says."""

import json
import os
import pathlib
import subprocess
import tempfile

binary, out, scan = os.environ["VASCULUM_BIN"], pathlib.Path(os.environ["VASCULUM_OUT"]), pathlib.Path(os.environ["VASCULUM_SCAN"])
COMMANDS = {"serve", "work", "run", "vary", "cohort", "validate", "phantom", "demo", "migrate", "backup", "key", "tenant", "verify-audit", "show", "openapi", "version", "man", "completions"}


def run(*arguments, **more):
    return subprocess.run(arguments, check=True, capture_output=True, text=True, timeout=60, **more).stdout


def manual(folder):
    """Every page is understood by groff without a warning, and has its options."""
    run(binary, "man", "--out", folder)
    pages = sorted(pathlib.Path(folder).glob("*.1"))
    names = {page.stem.removeprefix("vasculum-") for page in pages}
    assert COMMANDS <= names and "exec-job" not in names, names
    for page in pages:
        done = subprocess.run(["groff", "-man", "-Tascii", "-P-cbu", "-ww", str(page)], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0 and not done.stderr, f"{page.name}: {done.stderr}"
        assert "--help" in done.stdout, page.name
        if page.stem == "vasculum-vary":
            assert "--torsion" in done.stdout and "positive right-handed" in " ".join(done.stdout.split())
    return len(pages)


def completed(words):
    """What bash would offer for the last of these words."""
    script = f"""
        source <({binary} completions bash)
        COMP_WORDS=({" ".join(f"'{word}'" for word in words)}); COMP_CWORD={len(words) - 1}
        _vasculum vasculum '{words[-1]}' '{words[-2]}'
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    return set(run("bash", "-c", script).split())


def completions():
    assert COMMANDS <= completed(["vasculum", ""])
    assert completed(["vasculum", "co"]) == {"cohort", "completions"}
    assert {"--angle", "--torsion", "--plan"} <= completed(["vasculum", "vary", "--"])
    assert completed(["vasculum", "cohort", "x", "--kind", ""]) == {"angle", "branch"}
    for shell in ("zsh", "fish", "elvish", "powershell"):
        assert "verify-audit" in run(binary, "completions", shell), shell


def narrow():
    """No table is wider than the usual terminal; a path that is given may be."""
    with tempfile.TemporaryDirectory() as data:
        key = run(binary, "key", "create", "--data-dir", data, "--name", "ward 3", "--role", "upload")
        told = {
            "show": run(binary, "show", str(out)),
            "validate": run(binary, "validate", str(scan / "dicom")),
            "cohort": run(binary, "cohort", str(out)),
            "key list": run(binary, "key", "list", "--data-dir", data),
            "tenant list": run(binary, "tenant", "list", "--data-dir", data),
        }
    assert key.startswith("vsk_")
    for name, text in told.items():
        wide = [line for line in text.splitlines() if len(line) > 80]
        assert text and not wide, f"{name}: {wide}"
    return told


def unread():
    """A reader who has seen enough is no fault of anybody."""
    for command in (["show", str(out), "--json"], ["openapi"], ["man"]):
        program = subprocess.Popen([binary, *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        program.stdout.close()
        assert program.wait(60) == 0 and program.stderr.read() == b"", command


def shown(text):
    result = json.loads((out / "result.json").read_text())
    for angle in result["junctions"][0]["angles"]:
        low, high = angle["band95"]
        wanted = [angle["name"], f"{angle['value']:.2f}", f"{low:.2f}", "..", f"{high:.2f}"]
        assert wanted in [line.split() for line in text.splitlines()], f"{wanted} in\n{text}"
    assert json.loads(run(binary, "show", str(out / "result.json"), "--json")) == result


def main():
    with tempfile.TemporaryDirectory() as folder:
        pages = manual(folder)
    completions()
    told = narrow()
    shown(told["show"])
    missing = subprocess.run([binary, "show", "no-such-folder"], capture_output=True, text=True, timeout=60)
    assert missing.returncode == 2 and "input.unreadable" in missing.stderr
    assert "next:  check the path" in missing.stderr, missing.stderr
    unread()
    print(f"command line: {pages} pages of the manual without a warning of groff, completions in bash, {len(told)} tables within 80 columns")


main()
