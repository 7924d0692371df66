# SPDX-License-Identifier: Apache-2.0
"""Write results: JSON and YAML for programs, pages with charts for people."""
