"""A C compiler that remembers what it was given before, in the folder $EOMC_KEPT."""

import glob
import hashlib
import os
import shutil
import subprocess
import sys

given = sys.argv[1:]
out = given[given.index("-o") + 1] if "-o" in given else ""
total = hashlib.sha256(repr([x for x in given if x != out]).encode())
folders = {os.path.dirname(x) or "." for x in given if x.endswith(".c")}
headers = [header for folder in sorted(folders) for header in sorted(glob.glob(f"{folder}/*.h"))]
for name in (*given, *headers):
    if name != out and os.path.isfile(name):
        with open(name, "rb") as file:
            total.update(file.read())
kept = os.path.join(os.environ["EOMC_KEPT"], total.hexdigest())
if out and os.path.exists(kept):
    shutil.copy(kept, out)
    sys.exit(0)
done = subprocess.run(["cc", *given])
if done.returncode == 0 and out and os.path.isfile(out):
    os.makedirs(os.environ["EOMC_KEPT"], exist_ok=True)
    shutil.copy(out, f"{kept}.{os.getpid()}")
    os.rename(f"{kept}.{os.getpid()}", kept)
sys.exit(done.returncode)
