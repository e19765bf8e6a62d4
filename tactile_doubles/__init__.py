"""Doubles: controllers of real arms that speak their protocols, for rehearsals and tests."""
