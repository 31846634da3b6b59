// Prints every message of an MCAP file as a line of JSON: topic, sequence, log and publish time, data (base64).
import { McapIndexedReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
import { open } from "node:fs/promises";

const file = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, size) => {
      const bytes = new Uint8Array(Number(size));
      await file.read(bytes, 0, bytes.length, Number(offset));
      return bytes;
    },
  },
  decompressHandlers: await loadDecompressHandlers(),
});
for await (const message of reader.readMessages()) {
  const { topic } = reader.channelsById.get(message.channelId);
  const times = [message.logTime, message.publishTime].map(String);
  console.log(JSON.stringify([topic, message.sequence, ...times, Buffer.from(message.data).toString("base64")]));
}
await file.close();
