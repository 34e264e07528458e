// The servo protocol of morpheyes_daemon/wire/servo.py: COBS(body + CRC-16/CCITT-FALSE) + 0x00.
// Plain C without allocation, so that the sketch and a test on the host compile the very same lines.
#ifndef MORPHEYES_PROTOCOL_H
#define MORPHEYES_PROTOCOL_H

#include <stdint.h>
#include <string.h>

enum { PROTOCOL_VERSION = 1, MAX_BODY = 16, MAX_ENCODED = MAX_BODY + 1 };
enum { KIND_SET = 0x01, KIND_HELLO = 0x02, KIND_ACK = 0x81, KIND_WELCOME = 0x82, KIND_STATUS = 0x83 };
enum { VERDICT_APPLIED = 0, VERDICT_CLAMPED = 1 };
enum { FLAG_HOST_SILENT = 1, FLAG_COLD = 2 };

typedef struct { uint8_t bytes[MAX_BODY]; uint8_t length; } Body;
typedef struct { uint8_t buffer[MAX_ENCODED]; uint8_t length; uint8_t overlong; uint16_t dropped; } Receiver;

static inline uint16_t crc16(const uint8_t *data, uint8_t length) {
  uint16_t crc = 0xFFFF;
  while (length--) {
    crc ^= (uint16_t)(*data++ << 8);
    for (uint8_t bit = 0; bit < 8; bit++) crc = (uint16_t)((crc & 0x8000) ? (crc << 1) ^ 0x1021 : crc << 1);
  }
  return crc;
}

static inline void put_u8(Body *body, uint8_t value) { body->bytes[body->length++] = value; }
static inline void put_u16(Body *body, uint16_t value) { put_u8(body, value & 0xFF); put_u8(body, value >> 8); }
static inline void put_u32(Body *body, uint32_t value) { put_u16(body, value & 0xFFFF); put_u16(body, value >> 16); }
static inline uint16_t get_u16(const uint8_t *at) { return (uint16_t)(at[0] | at[1] << 8); }

// Close the body with its CRC and write the frame; `frame` holds MAX_ENCODED + 1 bytes. Returns the frame's length.
static inline uint8_t encode_frame(Body *body, uint8_t *frame) {
  uint16_t crc = crc16(body->bytes, body->length);
  put_u8(body, crc >> 8);
  put_u8(body, crc & 0xFF);
  uint8_t out = 1, code_at = 0, code = 1;
  for (uint8_t i = 0; i < body->length; i++) {
    if (body->bytes[i]) { frame[out++] = body->bytes[i]; code++; }
    else { frame[code_at] = code; code_at = out++; code = 1; }
  }
  frame[code_at] = code;
  frame[out++] = 0;
  return out;
}

// Undo COBS and check the CRC. Returns the body's length without the CRC, 0 when the frame is damaged.
static inline uint8_t decode_frame(const uint8_t *encoded, uint8_t length, uint8_t *body) {
  uint8_t out = 0;
  for (uint8_t i = 0; i < length;) {
    uint8_t code = encoded[i++];
    if (code == 0 || i + code - 1 > length) return 0;
    for (uint8_t n = 1; n < code; n++) body[out++] = encoded[i++];
    if (i < length) body[out++] = 0;
  }
  if (out < 3) return 0;
  uint16_t crc = (uint16_t)(body[out - 2] << 8 | body[out - 1]);
  return crc16(body, out - 2) == crc ? out - 2 : 0;
}

// Take one byte; returns the length of a body that it completed, else 0. `body` holds MAX_ENCODED bytes.
static inline uint8_t receive(Receiver *receiver, uint8_t byte, uint8_t *body) {
  if (byte) {
    if (receiver->length < MAX_ENCODED) receiver->buffer[receiver->length++] = byte;
    else receiver->overlong = 1;
    return 0;
  }
  uint8_t length = receiver->overlong ? 0 : decode_frame(receiver->buffer, receiver->length, body);
  if (!length && receiver->length) receiver->dropped++;
  receiver->length = receiver->overlong = 0;
  return length;
}

#endif
