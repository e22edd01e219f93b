"""Locate, name and size what a simulation lacks; knows no instrument (see `problem.Problem`)."""

from benchsim.diagnosis.diagnose import conclude as conclude
from benchsim.diagnosis.diagnose import diagnose as diagnose
from benchsim.diagnosis.naming import name as name
