# SPDX-License-Identifier: Apache-2.0
"""Search of the chain that explains a recording, and fits of its parameters."""
