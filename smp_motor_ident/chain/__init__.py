# SPDX-License-Identifier: Apache-2.0
"""Components between a command and a recording, each with its effect and its parameters."""
