"""From recordings of a robot arm to a model that could be built, one function a stage.

    recording, arm = jaxpanda.load("arm.csv"), jaxpanda.Arm.panda()
    found = jaxpanda.identify([recording], arm)
    links = jaxpanda.retrieve(found, arm=arm)
    jaxpanda.to_mjcf(links, "arm.xml")
    jaxpanda.validate("arm.xml", [recording])

The names below are read from their modules when first used, so that `import jaxpanda` stays light; nothing
here switches on float64, which identification needs (`jax.config.update("jax_enable_x64", True)`).
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from .arms.arm import Arm as Arm
    from .arms.model_file import ModelFile as ModelFile
    from .arms.model_file import Part as Part
    from .comparison import Comparison as Comparison
    from .comparison import compare as compare
    from .corrected import Corrected as Corrected
    from .demo import demonstrate as demonstrate
    from .diagnosis import Diagnosis as Diagnosis
    from .diagnosis import diagnose as diagnose
    from .ensemble import Ensemble as Ensemble
    from .ensemble import draw_ensemble as draw_ensemble
    from .errors import InputError as InputError
    from .excitation import excite as excite
    from .feasible import Bounds as Bounds
    from .fleet import diagnose_fleet as diagnose_fleet
    from .identification import Identification as Identification
    from .identification import identify as identify
    from .identification import identify_mass_gravity as identify_mass_gravity
    from .inspection import inspect as inspect
    from .payload import estimate_payload as estimate_payload
    from .pipeline import to_mjcf as to_mjcf
    from .prediction import predict as predict
    from .reading import Reading as Reading
    from .recordings import Recording as Recording
    from .recordings import load as load
    from .recordings import save as save
    from .rehearsal import Rehearsal as Rehearsal
    from .rehearsal import rehearse as rehearse
    from .retrieval import Retrieval as Retrieval
    from .retrieval import retrieve as retrieve
    from .rollout import replay as replay
    from .signals import prepare as prepare
    from .simulation import simulate as simulate
    from .validation import validate as validate

_HOME = {
    "Arm": "arms.arm",
    "Bounds": "feasible",
    "Comparison": "comparison",
    "Corrected": "corrected",
    "Diagnosis": "diagnosis",
    "Ensemble": "ensemble",
    "Identification": "identification",
    "InputError": "errors",
    "ModelFile": "arms.model_file",
    "Part": "arms.model_file",
    "Reading": "reading",
    "Recording": "recordings",
    "Rehearsal": "rehearsal",
    "Retrieval": "retrieval",
    "compare": "comparison",
    "demonstrate": "demo",
    "diagnose": "diagnosis",
    "diagnose_fleet": "fleet",
    "draw_ensemble": "ensemble",
    "estimate_payload": "payload",
    "excite": "excitation",
    "predict": "prediction",
    "identify": "identification",
    "identify_mass_gravity": "identification",
    "inspect": "inspection",
    "load": "recordings",
    "prepare": "signals",
    "rehearse": "rehearsal",
    "replay": "rollout",
    "retrieve": "retrieval",
    "save": "recordings",
    "simulate": "simulation",
    "to_mjcf": "pipeline",
    "validate": "validation",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from .versions import version

        return version("jaxpanda")
    if name not in _HOME:
        raise AttributeError(f"module 'jaxpanda' has no attribute {name!r}; it has {', '.join(_HOME)}")
    value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(_HOME)
