"""The verb `verify`: everything that a bag reports of its missions is recomputed and compared."""
