"""`cargo xtask bench service`: GET of a job by wrk, with and without a key, and the memory of 50 uploads at the same time.

Arguments: seconds of each run of wrk, MB of each upload (fewer where the disk has no room for all of them). Rates are shown beside the server's own processor time, which a busy machine
changes less.
"""

import http.client
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "python"))
from support import Service  # noqa: E402

SECONDS, AT_ONCE = int(sys.argv[1]), 50
MEGABYTES = min(int(sys.argv[2]), int(0.8 * shutil.disk_usage(tempfile.gettempdir()).free / AT_ONCE) >> 20)


def processor(pid):
    fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident(pid):
    return int(re.search(r"VmRSS:\s+(\d+)", pathlib.Path(f"/proc/{pid}/status").read_text()).group(1)) / 1024


def rate(service, path, *headers):
    before = processor(service.process.pid)
    command = ["wrk", "-t1", "-c32", f"-d{SECONDS}s", *[word for header in headers for word in ("-H", header)], service.address + path]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "Non-2xx" not in told, told
    spent = processor(service.process.pid) - before
    count = int(re.search(r"(\d+) requests in", told).group(1))
    return float(re.search(r"Requests/sec:\s+([\d.]+)", told).group(1)), 1e6 * spent / count


def reads(folder):
    for keys in (False, True):
        with Service(folder / f"reads{keys}", *([] if keys else ["--no-auth"]), key=None if keys else "none") as service:
            job = service.submit().headers["Location"]
            assert service.ended(job)["state"] == "succeeded"
            header = [f"Authorization: Bearer {service.key}"] if keys else []
            for path in ("/version", job):
                per_second, each = rate(service, path, *header)
                what = "GET of a job" if path == job else "GET /version"
                print(f"{what:<14} {'with a key' if keys else 'without keys':<13} {per_second:>8.0f}/s {each:>6.0f} us of processor each")


def upload(host):
    block, size = os.urandom(1 << 20), MEGABYTES << 20
    line = http.client.HTTPConnection(host, timeout=900)
    line.request("POST", "/v1/uploads", headers={"Tus-Resumable": "1.0.0", "Upload-Length": str(size)})
    made = line.getresponse()
    made.read()
    headers = {"Tus-Resumable": "1.0.0", "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream", "Content-Length": str(size)}
    line.request("PATCH", made.getheader("Location"), body=(block for _ in range(MEGABYTES)), headers=headers)
    kept = line.getresponse()
    kept.read()
    assert (kept.status, kept.getheader("Upload-Offset")) == (204, str(size)), kept.status


def uploads(folder):
    with Service(folder / "uploads", "--no-auth", "--workers", "0", key="none") as service:
        pid, host = service.process.pid, service.address.split("//")[1]
        senders = [threading.Thread(target=upload, args=(host,)) for _ in range(AT_ONCE)]
        before = peak = resident(pid)
        begun = time.time()
        [sender.start() for sender in senders]
        while any(sender.is_alive() for sender in senders):
            peak = max(peak, resident(pid))
            time.sleep(0.05)
        sent = len(list((folder / "uploads").rglob("uploads/*")))
        assert sent >= AT_ONCE, f"{sent} of {AT_ONCE} arrived"
        print(f"{AT_ONCE} uploads of {MEGABYTES} MB in {time.time() - begun:.0f} s: {before:.0f} MiB before, +{peak - before:.0f} at the peak")


with tempfile.TemporaryDirectory() as name:
    reads(pathlib.Path(name))
    uploads(pathlib.Path(name))
