"""The verb `info`: what a bag holds, and whether it is complete."""
