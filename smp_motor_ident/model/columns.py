"""Where the compiled pass finds each coordinate, generated from the fields of `Coordinates`.

For compiled code alone: everything else calls coordinates by their names.
"""

from smp_motor_ident.model.coordinates import place

A0, A1, A2, LN_TE = (place(n) for n in ("ln_a0", "ln_a1", "ln_a2", "ln_te"))
VC_PLUS, VC_MINUS, LOAD = (place(n) for n in ("vc_plus", "vc_minus", "load"))
LN_R, OFFSET, CURRENT_LAG = (place(n) for n in ("ln_r", "current_offset", "current_lag"))
DELAY, WINDOW = (place(n) for n in ("delay", "window"))
