"""The picture in the README: a virtual Panda that rubs at joint 4, where its model does not, diagnosed.

    python docs/picture.py            # writes docs/diagnosis.png

The recording is 20 s of the project's own Panda in MuJoCo's C engine with the sensor noise of the demo, and with
0.8 N·m of Coulomb friction that its file does not hold. What is drawn are the figures of the first finding in the
report that `jaxpanda diagnose` writes.
"""

import io
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxpanda import diagnosis, session
from jaxpanda.arms.export import panda_mjcf
from jaxpanda.diagnosis import page
from jaxpanda.simulation import JointFriction, panda_sensors, random_trajectory, simulate


def main() -> None:
    session.start()
    model, joint = panda_mjcf(), np.eye(7)[3]
    friction = JointFriction(viscous=0 * joint, coulomb=0.8 * joint)
    motion = random_trajectory(model, seed=1)
    log = simulate(model, motion, friction=friction, sensors=panda_sensors(), seed=1, name="recording.csv")
    found = diagnosis.diagnose(None, [log])
    print(*found.lines(), sep="\n")
    for one in found.findings:
        values = (f"{p['name']} {p['value']:.3f} ({p['std']:.3f}) {p['unit']}" for p in one.parameters)
        print(f"{one.effect}: {', '.join(values)}")
    first = page.sections(found)[1]
    with matplotlib.rc_context(
        {"font.size": 8, "lines.linewidth": 0.9, "axes.grid": True, "grid.alpha": 0.3}
    ):
        width, height = np.array([f.size for f in first.figures]).T
        canvas = Figure(figsize=(width.sum(), height.max()), dpi=100)
        FigureCanvasAgg(canvas)
        for part, figure in zip(canvas.subfigures(1, len(first.figures)), first.figures, strict=True):
            figure.draw(part)
        drawn = io.BytesIO()
        canvas.savefig(drawn)
    small = Image.open(drawn).convert("RGB").quantize(48)
    small.save(Path(__file__).with_name("diagnosis.png"), optimize=True)


if __name__ == "__main__":
    main()
