# SPDX-License-Identifier: Apache-2.0
"""MATLAB files: version 4 to 7.2 by scipy, version 7.3 by h5py where it is installed.

Vectors and the columns of matrices become columns of one table per length, fields of structures
by their path.
"""

from pathlib import Path

import numpy as np

from smp_motor_ident.bag.readers import apart
from smp_motor_ident.bag.readers.format import ColumnFile, Format
from smp_motor_ident.bag.storage import note
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError

_MAX_NAMED_OBJECTS = 4  # objects named in a message


def _open(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read a file of any version."""
    head, answer = apart.read("MATLAB", path, name, budget)
    columns = {key: np.load(answer, allow_pickle=False) for key in head.get("columns", ())}
    objects = ", ".join(list(dict.fromkeys(head["objects"]))[:_MAX_NAMED_OBJECTS])
    advice = (
        f"{name}: holds MATLAB objects, such as a timeseries or a Simulink Dataset, which only "
        f"MATLAB can read: {objects}; save its Time and Data as arrays there: "
        "t = x.Time; y = x.Data; save('log.mat', 't', 'y'), where of a Dataset x = data{1}.Values"
    )
    if head["objects"] and not columns:
        raise BagError(advice)
    file = ColumnFile(path, name, columns)
    if head["objects"]:
        file.problems.append(note("matlab_object", advice, "warning"))
    return file


FORMAT_4 = Format("MATLAB 4", (".mat",), b"\0\0\0\0", _open)
FORMAT_5 = Format("MATLAB", (".mat",), b"MATLAB 5.0 MAT", _open)
FORMAT_73 = Format("MATLAB 7.3", (".mat",), b"MATLAB 7.3 MAT", _open)
