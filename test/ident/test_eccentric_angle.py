# SPDX-License-Identifier: Apache-2.0
"""An encoder whose disc is off centre."""

import motors
import numpy as np
import pytest
from independent import TABLE_1, simulate

from smp_motor_ident.estimate import estimate
from smp_motor_ident.record import Hardware, Record


@pytest.mark.parametrize("error", [0.0, 0.003, 0.06])
def test_encoder_error_once_a_turn_is_found_with_its_size(error):
    rng = np.random.default_rng(1)
    t = np.arange(4000) / 200
    voltage = np.repeat(rng.uniform(-9.0, 9.0, 100), 40)
    r, inductance, k, j, b = TABLE_1["rear_left"]
    turned = simulate(t, voltage, r, inductance, k, j, b, 0.3 * k / r, 0 * t, 50)[:, 2]
    count = np.floor((turned + error * np.sin(turned + 1.0)) * 2000 / (2 * np.pi)).astype(np.int64)
    found = estimate(Record("motor", t, voltage, count=count, hardware=Hardware(1.0, 2000.0)))
    assert ("encoder_error" in [f.code for f in found.findings]) == (error > 0)
    if error:
        size = found.combinations["encoder_error"]
        assert abs(abs(size.value) - error) < 5 * size.std + 0.01 * error
    truth = motors.truth("rear_left", 0.3)
    motors.check(found, truth, ("dc_gain", "time_constant", "static_voltage"))
