"""Write the path of a double pendulum's tip as CSV. The command does the same:

    eomc run docs/examples/double_pendulum.toml --every 10 --out path.csv

python docs/examples/tip_path.py
"""

from pathlib import Path

import eomc

pendulum = eomc.load(Path(__file__).with_name("double_pendulum.toml"))
run = pendulum.simulate(every=10)
run.save("path.csv")  # t, coordinates, rates, outputs, energy: a row every 20 ms

x, y, speed = (run.outputs[name] for name in ("x", "y", "speed"))
print(f"{len(run.t)} rows in path.csv")
print(f"ends at x = {x[-1]:.6f} m, y = {y[-1]:.6f} m; fastest {speed.max():.3f} m/s")
print(f"energy changed by {abs(run.energy - run.energy[0]).max():.1e} J")
