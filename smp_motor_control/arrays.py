# SPDX-License-Identifier: Apache-2.0
"""Array types of both packages."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]
Places = NDArray[np.uint32]
