# SPDX-License-Identifier: Apache-2.0
"""Guess signal, wheel and unit of a field from its name."""

import re
from collections.abc import Sequence

from smp_motor_control.errors import is_ros_name

WORDS_OF_VOLTS = (
    r"volt|spannung|spanning|sp[äæ]nning|(?<!in)tens(?:i[oóu]|[ãa]o)|napi[eę]cie|nap[eěaä]t[ií]"
    r"|gerilim|feszülts|напряж|电压|電圧|전압"
)
WORDS_OF_RADIANS = r"rad|omega|ω|(?:^|\W|_)w(?:$|\W|_)"
ROLES = {
    # Patterns of field and topic names, the most specific first.
    "direction": r"(?:^|\W|_)dir(?:ection)?(?:$|\W|_)|richtung|sentido|direcci",
    "voltage": WORDS_OF_VOLTS + r"|pwm|duty|throttle|entrada|eingang|^in$|(?:^|\W|_)power(?:$|\W|_)"
    r"|esfor[çc]o|esfuerzo|(?:^|\W|_)(?:cmd|command|effort|u|input|v_?in)(?:$|\W|_)",
    "current": r"current|strom|courant|corriente|corrente|curent|intensi[dt]|proud|akım|(?:^|\W)ток"
    r"|电流|電流|전류|amp(?:s|ere)?(?:$|\W|_)",
    "count": r"tick|count|encoder|impuls|(?:^|\W|_)enc(?:$|\W|_)",
    "velocity": r"rpm|velo(?:$|\W|_|[cz]i)|speed|omega|drehzahl|geschwindigkeit|vitesse|vitez"
    r"|pr[eę]dko|obroty|rychlos|ot[aá][cč]k|snelheid|toerental|hastighe[dt]|varvtal|hız|sebess"
    r"|fordulat|скорост|速度|속도|(?:^|\W|_)(?:vel|w|y|tach|tacho|taco|output_data)(?:$|\W|_|met|g[eé]n)",
    "position": r"position|posici|posizi|posi[cç]|angle|winkel|theta|konum|угол|角度|각도"
    r"|(?:^|\W|_)(?:pos|pot|pote)(?:$|\W|_|nt|nci)",
}
MOTIONS = ("velocity", "position", "count")
NOT_VOLTAGE = r"twist|cmd_vel|linear|angular|batter|supply|vbat"
TORQUE_NAMES = r"effort"
"""Torque [N m] of ``sensor_msgs/JointState``; some drivers store their command in it."""
POSE_NAMES = (
    r"pose(?:$|\W|_|[A-Z])|orientation|quaternion|(?:^|\W|_)(?:linear|angular)(?:$|\W|_)|translation"
    r"|transform|accel|gyro|magnet|(?:^|\W|_)(?:odom|gps|imu|point)(?:$|\W|_)"
)
"""Names of the robot's pose, which belong to no motor."""
VOLTAGE_NAMES = WORDS_OF_VOLTS + r"|pwm|duty|throttle"
SPEED_COMMAND = (
    r"twist|cmd_vel|vel_cmd|(?:speed|velocity|rpm)_(?:cmd|command|setpoint|set_point|target|ref)"
    r"|(?:cmd|command|setpoint|target|desired|ref)(?:_wheel)?_(?:speed|vel|velocity|rpm)"
)
SUPPLY_NAMES = r"(?:^|\W|_)v_?in(?:$|\W|_)"
NOT_MOTION = (
    r"set_?point|target|desired|autospeed|refer[eê]n[ct]|soll|cmd|command|consign|[\W_]m?v$"
    r"|(?:^|\W|_)(?:erro?r?e?|erreur|fehler|hata|uchyb|ошибка)(?:$|\W|_)"
)
UNIT_HINTS = {
    # Units that names hint at, as a mapping writes them
    "velocity": ((r"rpm|drehzahl", ":rpm"), (r"deg", ":deg/s")),
    "position": ((r"deg", ":deg"),),
    "voltage": ((r"duty", ":duty"), (r"pwm|throttle", ":pwm")),
}
_SIDES = (
    *("front", "rear", "back", "left", "right", "fl", "fr", "rl", "rr", "bl", "br"),
    *("links", "rechts", "gauche", "droite", "izquierda", "derecha", "izquierdo", "derecho"),
    *("izq", "esquerda", "direita", "esquerdo", "direito", "sinistra", "destra"),
)
_LETTER = re.compile(r"(.*?)[\W_]*([abclrABCLR]|\d)(?:[\W_]*[\[(].*)?")
"""Name that ends with the letter or digit of a motor, before an optional unit."""
_LETTERS = {"l": "left", "r": "right"}


_MOTOR = r"(?:motor|wheel|joint|actuator|servo|axis|axle)"
_NUMBERED = re.compile(rf"{_MOTOR}[\W_]*(?:id|no|nr|num|number|idx|index|name)\W*", re.IGNORECASE)
_NAMED = re.compile(_MOTOR, re.IGNORECASE)


def separates_motors(column: str, words: Sequence[str] = ()) -> bool:
    """Return whether a column names the motor of each row: ``motor_id``.

    A column called ``wheel`` alone does if its words are sides, letters or numbered.
    """
    sided = (find_side(word) or re.fullmatch(r".*\d|[A-Za-z]", word) for word in words)
    named = bool(words and _NAMED.fullmatch(column.strip())) and all(sided)
    return named or _NUMBERED.fullmatch(column.strip()) is not None


def split_words(name: str) -> str:
    """Return a name with its words separated: ``velLeft`` is ``vel_Left``, ``u2`` is ``u_2``."""
    return re.sub(r"(?<=[a-z\d])(?=[A-Z])|(?<=[A-Za-z])(?=\d+$)", "_", name)


def find_role(topic: str, path: str) -> str:
    """Return a field's role by its own name, else by its parent's, else by its topic's."""
    for text in (*reversed(re.sub(r"\[[^\]]*\]", "", path).split(".")), topic):
        roles = [r for r, pattern in ROLES.items() if re.search(pattern, split_words(text), re.I)]
        if roles[:1] == ["voltage"] and "velocity" in roles and not names_voltage(text):
            return ""  # a speed command
        if roles:
            return roles[0]
    return ""


def find_pose_fields(paths: Sequence[str]) -> set[str]:
    """Return the fields of a robot's pose: x and y together with a heading."""
    by_name: dict[tuple[str, str], str] = {}
    for path in paths:
        whole, dot, name = path.rpartition(".")
        by_name[whole + dot, name.lower()] = path
    faced = {whole for whole, name in by_name if name in ("theta", "yaw", "heading", "phi", "psi")}
    both = {whole for whole in faced if (whole, "x") in by_name and (whole, "y") in by_name}
    return {path for (whole, name), path in by_name.items() if whole in both and name in "xyz"}


def is_speed_command(name: str) -> bool:
    """Return whether type and name denote a speed command instead of a voltage."""
    speed = re.search(SPEED_COMMAND, split_words(name), re.IGNORECASE) is not None
    return speed and not names_voltage(name)


def names_voltage(text: str) -> bool:
    """Return whether a name denotes a voltage or duty cycle, not just a command."""
    return re.search(VOLTAGE_NAMES, text, re.IGNORECASE) is not None


def find_side(source: str) -> str:
    """Return the side of the robot in a name."""
    words = re.split(r"[^a-z]+", split_words(source).lower())
    return "_".join(side for side in _SIDES if side in words)


def find_motor(name: str) -> str:
    """Return the motor whose letter or digit a signal's name ends in: ``velL``, ``pwm_2``."""
    match = _LETTER.fullmatch(name)
    if match is None or not find_role("", match[1]):
        return ""
    letter = match[2].lower()
    return _LETTERS.get(letter, f"motor_{letter}")


def find_parent(path: str) -> str:
    """Return the first name of a field's path where it is a ROS name; else nothing."""
    whole, dot, _ = path.partition(".")
    return whole if dot and is_ros_name(whole) else ""


def is_excluded(role: str, text: str) -> bool:
    """Return whether a type, topic or name rules out a role."""
    if role in ("current", "direction"):
        return False
    if re.search(POSE_NAMES, text, re.IGNORECASE):
        return True
    return re.search(NOT_VOLTAGE if role == "voltage" else NOT_MOTION, text, re.I) is not None
