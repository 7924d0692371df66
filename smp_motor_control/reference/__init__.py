# SPDX-License-Identifier: Apache-2.0
"""Speed references that are smooth and within the limits of the drive."""
