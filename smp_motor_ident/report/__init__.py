# SPDX-License-Identifier: Apache-2.0
"""Results for people and for programs: JSON, YAML, and a page with charts."""
