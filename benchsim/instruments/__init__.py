"""Instruments: what joins the rooms of one kind of experiment for the jobs."""
