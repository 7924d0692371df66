"""From prepared records to the fitted model: start, descent, order selection, uncertainty."""
