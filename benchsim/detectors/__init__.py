"""Detector arrays around the receiver: heliostats told apart by the rates at which their prisms turn."""
