// Teensy 3.2: moves two L12-R linear servos, one per camera, to the baseline that the daemon asks for.
// No pulses until the first target: an unpowered L12 holds its place. When the daemon falls silent the last target
// is held. The pulses come from the timer hardware in 16-bit steps (0.3 us, 0.03 mm), finer than Servo.h's 1 us.
#include "protocol.h"

const int LEFT_PIN = 9, RIGHT_PIN = 10;                             // both on FTM0, one frequency
const uint16_t MIN_BASELINE = 10000, MAX_BASELINE = 30000;          // 0.01 mm; one camera travels half of it
const float RETRACTED_US = 1000, EXTENDED_US = 2000, FRAME_HZ = 50; // L12-R data sheet: pulse over the 100 mm stroke
const uint32_t STATUS_MS = 200, HOST_SILENT_MS = 1000;
const uint16_t FIRMWARE = 1;

Receiver receiver;
uint16_t target = 0;                                                // 0: none since the boot
uint32_t heard_ms = 0, status_ms = 0;

void drive(int pin, float extension) {
  float pulse_us = RETRACTED_US + extension * (EXTENDED_US - RETRACTED_US);
  analogWrite(pin, (int)lroundf(pulse_us * 1e-6f * FRAME_HZ * 65536));
}

void move_to(uint16_t baseline) {
  target = baseline;
  float extension = (float)(target - MIN_BASELINE) / (MAX_BASELINE - MIN_BASELINE);
  drive(LEFT_PIN, extension);
  drive(RIGHT_PIN, extension);
}

void send(Body *body) {
  uint8_t frame[MAX_ENCODED + 1];
  uint8_t length = encode_frame(body, frame);
  if (Serial.availableForWrite() >= length) Serial.write(frame, length); // never block on a dead host
}

void on_set(uint8_t seq, uint16_t wanted) {
  uint16_t applied = constrain(wanted, MIN_BASELINE, MAX_BASELINE);
  if (applied != target) move_to(applied);
  Body ack = {};
  put_u8(&ack, KIND_ACK); put_u8(&ack, seq);
  put_u8(&ack, applied == wanted ? VERDICT_APPLIED : VERDICT_CLAMPED); put_u16(&ack, applied);
  send(&ack);
}

void on_hello() {
  Body welcome = {};
  put_u8(&welcome, KIND_WELCOME); put_u8(&welcome, PROTOCOL_VERSION); put_u16(&welcome, FIRMWARE);
  put_u16(&welcome, MIN_BASELINE); put_u16(&welcome, MAX_BASELINE);
  send(&welcome);
}

void send_status(uint32_t now_ms) {
  uint8_t flags = (now_ms - heard_ms > HOST_SILENT_MS ? FLAG_HOST_SILENT : 0) | (target ? 0 : FLAG_COLD);
  Body status = {};
  put_u8(&status, KIND_STATUS); put_u32(&status, now_ms); put_u16(&status, target);
  put_u8(&status, flags); put_u16(&status, receiver.dropped);
  send(&status);
  digitalWrite(LED_BUILTIN, flags ? LOW : HIGH);
}

void setup() {
  Serial.begin(115200);                                             // USB: the rate does not matter
  pinMode(LED_BUILTIN, OUTPUT);
  analogWriteResolution(16);
  analogWriteFrequency(LEFT_PIN, FRAME_HZ);
  analogWriteFrequency(RIGHT_PIN, FRAME_HZ);
}

void loop() {
  uint8_t body[MAX_ENCODED];
  while (Serial.available()) {
    uint8_t length = receive(&receiver, Serial.read(), body);
    if (length) heard_ms = millis();
    if (length == 4 && body[0] == KIND_SET) on_set(body[1], get_u16(body + 2));
    if (length == 2 && body[0] == KIND_HELLO) on_hello();
  }
  uint32_t now_ms = millis();
  if (now_ms - status_ms >= STATUS_MS) { status_ms = now_ms; send_status(now_ms); }
}
