"""One pass over the data, compiled: propagate, differentiate, and gather the normal equations."""
