"""What laws of several effects share: sites, experiments, and whether values lie on a lattice."""
