"""Files of robots: their links, meshes and shapes, and how they are changed."""
