"""What fields are called: which signal of which wheel a name may mean, and in which unit."""

import re

WORDS_OF_VOLTS = r"volt|spannung|tension|napi[eę]cie|напряж|电压|電圧"
ROLES = {
    # What a field or its topic is called, the most telling first.
    "direction": r"(?:^|\W|_)dir(?:ection)?(?:$|\W|_)|richtung|sentido|direcci",
    "voltage": WORDS_OF_VOLTS + r"|pwm|duty|throttle|entrada|eingang|^in$"
    r"|(?:^|\W|_)(?:cmd|command|effort|u|input)(?:$|\W|_)",
    "current": r"current|strom|courant|corriente|corrente|(?:^|\W)ток|电流|電流"
    r"|amp(?:s|ere)?(?:$|\W|_)",
    "count": r"tick|count|encoder|impuls|(?:^|\W|_)enc(?:$|\W|_)",
    "velocity": r"rpm|velo(?:$|\W|_|[cz]i)|speed|omega|drehzahl|geschwindigkeit|vitesse"
    r"|pr[eę]dko|скорост|速度|(?:^|\W|_)(?:vel|w|y)(?:$|\W|_)",
    "position": r"position|posici|posizi|angle|winkel|theta|угол|角度|(?:^|\W|_)pos(?:$|\W|_)",
}
MOTIONS = ("velocity", "position", "count")
NO_VOLTAGE = r"twist|cmd_vel|linear|angular|batter|supply|vbat|vin(?:$|\W|_)"
NO_MOTION = r"set_?point|target|desired|reference|soll|cmd|command|[\W_]m?v$"
_HINTS = {
    "velocity": ((r"rpm|drehzahl", ":rpm"), (r"deg", ":deg/s")),
    "position": ((r"deg", ":deg"),),
    "voltage": ((r"duty", ":duty"), (r"pwm|throttle", ":pwm")),
}
_SIDES = ("front", "rear", "back", "left", "right", "fl", "fr", "rl", "rr", "bl", "br")


def role_of(topic: str, path: str) -> str:
    """Return what a field is by its own name, or else by its topic's."""
    for text in (path.partition("[")[0], topic):
        for role, pattern in ROLES.items():
            if re.search(pattern, text, re.IGNORECASE):
                return role
    return ""


def hint_of(role: str, source: str) -> str:
    """Return the unit that a name hints at, as a mapping writes it."""
    hints = (text for pattern, text in _HINTS.get(role, ()) if re.search(pattern, source, re.I))
    return next(hints, "")


def wheel_of(source: str) -> str:
    """Return the side of the robot that a name tells."""
    words = re.split(r"[^a-z]+", source.lower())
    return "_".join(side for side in _SIDES if side in words)
