"""Gymnasium's Pendulum-v1 as a backend of Gapcert."""
