"""How a plan is found: by a program that is solved once, about a plan before, or along a corridor to where plans end."""
