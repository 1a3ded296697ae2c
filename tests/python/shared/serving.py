"""The service for a test: started on a free port with a new data folder and its first key."""

import os
import re
import subprocess
import sys


def serve(folder, *options, **popen):
    """Starts the binary; gives its process, address and admin key."""
    process = subprocess.Popen(
        [os.environ["VASCULUM_BIN"], "serve", "--listen", "127.0.0.1:0", "--data-dir", str(folder), *options],
        stdout=subprocess.PIPE, text=True, **popen,
    )
    address = key = None
    for line in process.stdout:
        address = address or (line.split()[-1] if line.startswith("listening on ") else None)
        found = re.search(r"vsk_[0-9a-f]+", line)
        key = key or (found and found.group())
        if address and key:
            return process, address, key
    sys.exit("the service did not start")
