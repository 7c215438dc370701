"""What makes an editor a help."""
