"""The verb `verify`: recomputes the missions of a bag and compares them to what was recorded."""
