"""The candidate structures, simplest first; a new one is a file and a line here."""

from smp_motor_ident.model.electromechanical import SENSORS, Electromechanical, sensor_of
from smp_motor_ident.model.first_order import FirstOrder
from smp_motor_ident.model.second_order import SecondOrder
from smp_motor_ident.model.static_gain import StaticGain
from smp_motor_ident.model.structure import Structure

__all__ = [
    "CANDIDATES",
    "MODELS",
    "SENSORS",
    "Electromechanical",
    "FirstOrder",
    "SecondOrder",
    "StaticGain",
    "Structure",
    "sensor_of",
]

CANDIDATES: dict[str, type[Structure]] = {
    c.name: c for c in (StaticGain, FirstOrder, SecondOrder, Electromechanical)
}
MODELS = tuple(CANDIDATES)
"""What a user may ask for; ``_asymmetric`` may follow each name."""
