"""What a process that diagnoses one recording after the other holds, and what it gives back."""

import argparse
import tempfile
from pathlib import Path

from run import ARM, SENSORS

from jaxpanda import session
from jaxpanda.fleet import work
from jaxpanda.fleet.work import Keys, Options, Task
from jaxpanda.recordings import save
from jaxpanda.simulation import JointFriction, random_trajectory, simulate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=12, help="recordings")
    parser.add_argument("--same", action="store_true", help="all of one length, else each of its own")
    given = parser.parse_args()
    session.start()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = folder / "arm.xml"
        model.write_text(ARM)
        keys = Keys(Options())
        for i in range(given.count):
            seconds = 3.0 if given.same else 2.5 + 0.1 * i
            motion = random_trajectory(model, i, period=3.0, speed=2.0, acceleration=12.0)
            friction = JointFriction(viscous=0.2, coulomb=0.1 * (1 + i % 5))
            log = simulate(
                model, motion, duration=seconds, rate=200.0, friction=friction, sensors=SENSORS, seed=i
            )
            path = folder / f"{i}.csv"
            save(log, path)
            work.shard(Task(keys.of(path, model, ()), path, model, (), Options()))
            print(f"after {i + 1}: {work.memory() / 1e6:.0f} MB", flush=True)
    work.relieve()
    print(f"programs given back: {work.memory() / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
