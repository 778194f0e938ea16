"""Speed against error, reference solutions, plots, equations as text."""
