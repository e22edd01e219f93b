"""Locate, name and size what a simulation lacks; knows no instrument (see `problem.Problem`)."""
