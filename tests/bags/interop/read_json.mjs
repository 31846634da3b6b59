// Validates every message on a JSON channel of an MCAP file against the channel's schema; prints topics and counts.
import { McapIndexedReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
import { FileHandleReadable } from "@mcap/nodejs";
import Ajv2020 from "ajv/dist/2020.js";
import { open } from "node:fs/promises";

const file = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers: await loadDecompressHandlers(),
});
const text = new TextDecoder();
const validators = new Map();
const counts = {};
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  if (channel.messageEncoding !== "json") continue;
  const schema = reader.schemasById.get(channel.schemaId);
  if (schema.encoding !== "jsonschema") throw new Error(`${channel.topic}: ${schema.encoding}`);
  if (!validators.has(schema.id)) {
    validators.set(schema.id, new Ajv2020().compile(JSON.parse(text.decode(schema.data))));
  }
  const valid = validators.get(schema.id);
  if (!valid(JSON.parse(text.decode(message.data)))) throw new Error(JSON.stringify(valid.errors));
  counts[channel.topic] = (counts[channel.topic] ?? 0) + 1;
}
console.log(JSON.stringify(counts));
await file.close();
