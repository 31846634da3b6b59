"""The verb `info`: content and completeness of a bag."""
