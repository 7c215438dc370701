"""How plugins declare what they offer, and how it is found."""
