"""Parts of channels beyond path loss: what they draw, and gains from tables."""
