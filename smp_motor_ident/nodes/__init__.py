# SPDX-License-Identifier: Apache-2.0
"""Nodes that use identification: record, play, identifier."""
