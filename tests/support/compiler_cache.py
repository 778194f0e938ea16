"""A C compiler that stores its results in the folder $EOMC_KEPT and reuses them."""

import glob
import hashlib
import os
import shutil
import subprocess
import sys

arguments = sys.argv[1:]
out = arguments[arguments.index("-o") + 1] if "-o" in arguments else ""
total = hashlib.sha256(repr([x for x in arguments if x != out]).encode())
folders = {os.path.dirname(x) or "." for x in arguments if x.endswith(".c")}
headers = [header for folder in sorted(folders) for header in sorted(glob.glob(f"{folder}/*.h"))]
for name in (*arguments, *headers):
    if name != out and os.path.isfile(name):
        with open(name, "rb") as file:
            total.update(file.read())
stored = os.path.join(os.environ["EOMC_KEPT"], total.hexdigest())
if out and os.path.exists(stored):
    shutil.copy(stored, out)
    sys.exit(0)
process = subprocess.run(["cc", *arguments])
if process.returncode == 0 and out and os.path.isfile(out):
    os.makedirs(os.environ["EOMC_KEPT"], exist_ok=True)
    shutil.copy(out, f"{stored}.{os.getpid()}")
    os.rename(f"{stored}.{os.getpid()}", stored)
sys.exit(process.returncode)
