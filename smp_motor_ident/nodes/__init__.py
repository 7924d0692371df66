"""Nodes that need what is known of motors: record, play, identifier."""
