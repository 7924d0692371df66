"""MATLAB files: version 4 to 7.2 by scipy, version 7.3 by h5py where it is installed.

Vectors and the columns of matrices become columns of one table per length, fields of structures
by their path.  Spoilt bytes may kill compiled readers or make them ask for any amount of memory: a
process of its own reads (`apart/matlab.py`), with no more memory than the recording may unpack to.
"""

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from smp_motor_ident.bag.readers.format import ColumnFile, Format
from smp_motor_ident.bag.storage import found
from smp_motor_ident.bag.unpack import Budget
from smp_motor_ident.errors import BagError

_TOLD = 4  # objects that are named in a message
_READER = Path(__file__).parent / "apart" / "matlab.py"


def _open(path: Path, name: str, budget: Budget) -> ColumnFile:
    """Read a file of any version."""
    command = [sys.executable, str(_READER), str(budget.left)]
    done = subprocess.run(command, input=path.read_bytes(), capture_output=True, check=False)
    if done.returncode:
        raise BagError(f"{name}: damaged MATLAB file (its reader ends with {done.returncode})")
    answer = io.BytesIO(done.stdout)
    head = json.loads(answer.readline())
    if head["too_large"]:
        budget.take(budget.left + 1)
    budget.take(len(done.stdout))
    if head["error"]:
        raise BagError(f"{name}: {head['error']}")
    columns = {key: np.load(answer, allow_pickle=False) for key in head["columns"]}
    advice = f"{name}: {_advice(head['objects'])}"
    if head["objects"] and not columns:
        raise BagError(advice)
    file = ColumnFile(path, name, columns)
    if head["objects"]:
        file.problems.append(found("matlab_object", advice, "warning"))
    return file


def _advice(objects: list[str]) -> str:
    """Return what to do about objects, which MATLAB alone can open."""
    some = ", ".join(list(dict.fromkeys(objects))[:_TOLD])
    return (
        "holds MATLAB objects, such as a timeseries or a Simulink Dataset, which only MATLAB can "
        f"read: {some}; save its Time and Data as arrays there: "
        "t = x.Time; y = x.Data; save('log.mat', 't', 'y'), where of a Dataset x = data{1}.Values"
    )


FORMAT_4 = Format("MATLAB 4", (".mat",), b"\0\0\0\0", _open)
FORMAT_5 = Format("MATLAB", (".mat",), b"MATLAB 5.0 MAT", _open)
FORMAT_73 = Format("MATLAB 7.3", (".mat",), b"MATLAB 7.3 MAT", _open)
