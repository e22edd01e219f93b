"""From photographs as they come off a camera to a recording that can be used: what they say, and what is amiss."""
