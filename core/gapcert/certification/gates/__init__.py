"""What is probed before any certificate: that f̂ is a function of (x, u), and what its hidden state does to it."""
