"""Two-axis mounts: heliostats and telescopes as the second instrument of the diagnosis."""
