"""LipSDP: the best Lipschitz constant of a neural network that diagonal multipliers prove, at its optimum."""
