// Runs the sketch's protocol on the host: reads hex frames on standard input, writes what it made of them.
//   "frame HEX"  feed the bytes; prints one "body HEX" per completed body, then "dropped N" since the start
//   "body HEX"   prints "frame HEX", the frame of that body
#include <stdio.h>

#include "../../firmware/morpheyes_servo/protocol.h"

static int from_hex(const char *text, uint8_t *bytes) {
  int count = 0;
  unsigned value;
  while (sscanf(text + 2 * count, "%2x", &value) == 1) bytes[count++] = (uint8_t)value;
  return count;
}

static void print_hex(const char *name, const uint8_t *bytes, int count) {
  printf("%s ", name);
  for (int i = 0; i < count; i++) printf("%02x", bytes[i]);
  printf("\n");
}

int main(void) {
  static char line[400100], text[400100];
  static uint8_t bytes[200050];
  Receiver receiver = {0};
  char verb[8];
  while (fgets(line, sizeof line, stdin) && sscanf(line, "%7s %400000s", verb, text) == 2) {
    int count = from_hex(text, bytes);
    if (verb[0] == 'b') {
      Body body = {0};
      uint8_t frame[MAX_ENCODED + 1];
      for (int i = 0; i < count; i++) put_u8(&body, bytes[i]);
      print_hex("frame", frame, encode_frame(&body, frame));
    } else {
      uint8_t body[MAX_ENCODED];
      for (int i = 0; i < count; i++) {
        uint8_t length = receive(&receiver, bytes[i], body);
        if (length) print_hex("body", body, length);
      }
      printf("dropped %u\n", receiver.dropped);
    }
  }
  return 0;
}
