# SPDX-License-Identifier: Apache-2.0
"""The mapping's grammar, on the command line and in YAML."""

import numpy as np
import pytest
from recordings import read_table

from smp_motor_ident.bag import Signal, load_mapping, parse_mapping
from smp_motor_ident.bag.mapping import read_mapping
from smp_motor_ident.errors import BagError


@pytest.mark.parametrize(
    ("text", "signal"),
    [
        ("voltage=/pwm.data*12/255", Signal("/pwm", "data", 12 / 255, 0.0)),
        ("voltage=/a/b_c.d.e[3].f", Signal("/a/b_c", "d.e[3].f", 1.0, 0.0)),
        ("voltage=/pwm.data*-12/255", Signal("/pwm", "data", -12 / 255, 0.0)),
        ("voltage=/x.data-127*12/128", Signal("/x", "data", 1.0, -127 * 12 / 128)),
        ("voltage=/x.data*2e-3 + .5:mV", Signal("/x", "data", 2e-3, 0.5, "mV")),
        ("voltage=/x.data:%", Signal("/x", "data", 1.0, 0.0, "%")),
        ("velocity=/js.velocity[left_wheel]:RPM@motor",
         Signal("/js", "velocity[left_wheel]", 1.0, 0.0, "rpm", "motor")),
        ("velocity=y:deg/s", Signal("", "y", 1.0, 0.0, "deg/s")),
        ("velocity=Motor_Speed(RPM):rpm", Signal("", "Motor_Speed(RPM)", 1.0, 0.0, "rpm")),
        ('velocity="left-wheel speed"*2', Signal("", "left-wheel speed", 2.0, 0.0)),
        ('velocity="a:b*c"', Signal("", "a:b*c", 1.0, 0.0)),
        ('velocity="a b=c"*2', Signal("", "a b=c", 2.0, 0.0)),
        ('velocity="say ""a"""', Signal("", 'say "a"', 1.0, 0.0)),
        ("velocity=/plot/juggler/column", Signal("", "/plot/juggler/column", 1.0, 0.0)),
        ("count=/enc.ticks:counts", Signal("/enc", "ticks", 1.0, 0.0, "ticks")),
        ("time=Timestamp(ms):ms", Signal("", "Timestamp(ms)", 1.0, 0.0, "ms")),
    ],
)  # fmt: skip
def test_signal_is_parsed_from_text(text, signal):
    name = text.partition("=")[0]
    mapping = parse_mapping([text])
    signals = mapping.motors["motor"].signals if mapping.motors else mapping.defaults.signals
    found = signals[name]
    assert found.scale == pytest.approx(signal.scale, rel=1e-15)
    assert found.offset == pytest.approx(signal.offset, rel=1e-15)
    for name in ("topic", "field", "unit", "shaft"):
        assert getattr(found, name) == getattr(signal, name)


def test_yaml_and_command_line_mappings_are_equivalent(tmp_path):
    file = tmp_path / "map.yaml"
    file.write_text(
        "supply_voltage: 12\n"
        "held: before\n"
        "types: [msgs]\n"
        "motors:\n"
        "  left:\n"
        "    voltage: {topic: /pwm, field: data, scale: 12/255}\n"
        "    velocity: /joint_states.velocity[left]:rpm\n"
        "    gear_ratio: 65.5\n"
    )
    loaded = load_mapping(file)
    items = [
        "supply_voltage=12 held=before",
        "left.voltage=/pwm.data*12/255",
        "left.velocity=/joint_states.velocity[left]:rpm",
        "left.gear_ratio=65.5",
    ]
    parsed = parse_mapping(items, [str(tmp_path / "msgs")])
    assert loaded == parsed
    assert read_mapping(str(file)) == read_mapping(file) == loaded
    assert read_mapping(parsed) is parsed
    assert read_mapping(items).motors == parsed.motors


@pytest.mark.parametrize(
    ("item", "reason"),
    [
        ("voltage", "write KEY=VALUE"),
        ("voltage=", "write KEY=VALUE"),
        ("volts=/a.b", "not a key of a mapping; use voltage"),
        ("left.volts=/a.b", "not a key of a mapping"),
        ("voltage=/a.b:furlong", "cannot be in 'furlong'; use one of V"),
        ("velocity=/a.b*0", "its scale is 0"),
        ("velocity=/a.b*1/0", "divides by zero"),
        ("velocity=/a.b@axle", "'axle'; use wheel or motor"),
        ("velocity=/a.b[c", "field path"),
        ("gear_ratio=-3", "it must be a positive number"),
        ("gear_ratio=fast", "must be a number"),
        ("encoder_bits=65", "from 0 to 64"),
        ("encoder_bits=1.5", "from 0 to 64"),
        ("held=never", "use after or before"),
        ("voltage=/a.b voltage=/c.d", "given twice"),
        ("left.velocity=/a.b voltage=/c.d", "needs its wheel"),
    ],
)
def test_invalid_mapping_value_is_refused_with_valid_alternatives(item, reason):
    with pytest.raises(BagError) as refused:
        parse_mapping([item])
    assert reason in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "text",
    ["[1, 2]", "motors: 3", "motors: {left: 3}", "motors: {left: {voltage: {topic: /a}}}",
     "motors: {left: {voltage: {topic: /a, field: b, unti: V}}}", "types: {a: 1}",
     ":\n  - {", "\tx: 1"],
)  # fmt: skip
def test_invalid_mapping_file_is_refused_by_name(tmp_path, text):
    file = tmp_path / "map.yaml"
    file.write_text(text)
    with pytest.raises(BagError, match=r"map\.yaml") as refused:
        load_mapping(file)
    assert "\n" not in str(refused.value)


def test_missing_mapping_file_is_refused_by_name(tmp_path):
    with pytest.raises(BagError, match=r"nothing\.yaml"):
        load_mapping(tmp_path / "nothing.yaml")


def test_constant_voltage_is_given_in_mapping(tmp_path):
    mapping = ["voltage=w*0+12 velocity=w time=t"]
    record = read_table(tmp_path, mapping, t=0.01 * np.arange(30), w=range(0, 600, 20))
    assert np.all(record.voltage == 12.0)


@pytest.mark.parametrize("name", ["a-b", "1", "a b", "ä", "a\n"])
def test_wheel_without_valid_ros_name_is_refused(name):
    with pytest.raises(BagError, match="is not a ROS name"):
        read_mapping({"motors": {name: {"voltage": "u", "velocity": "y"}}})
