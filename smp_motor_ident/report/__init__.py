"""Results for people and for programs: JSON, YAML, and a page with charts."""
