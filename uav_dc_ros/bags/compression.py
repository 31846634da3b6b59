"""How the chunks of a bag are compressed, by name. What writes them is apart: it takes long to import."""

COMPRESSIONS = ("zstd", "lz4", "none")
