# SPDX-License-Identifier: Apache-2.0
"""Estimates while a motor runs."""
