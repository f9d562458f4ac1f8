"""How a team learns: nets, loss, replay. The only room with torch."""
