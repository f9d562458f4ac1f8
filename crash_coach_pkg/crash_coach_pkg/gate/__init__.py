"""What the gate decides of every command that passes it."""
