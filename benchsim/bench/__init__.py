"""What an experiment is: laser, mirror, screen, camera, recording; and where it all stands."""
