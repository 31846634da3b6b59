"""The users on the ground: their settings, and how well a mission served them."""
