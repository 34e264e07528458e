// Runs the whole sketch on the host, with the few Arduino calls it makes and a clock set by standard input:
//   "ms N"        lets N milliseconds pass, one loop() each
//   "bytes HEX"   hands bytes to the serial port and runs loop() once
// Prints "sent HEX" for what the sketch writes and "pulse PIN TICKS" for every pulse width it sets (of 65536).
#include <math.h>
#include <stdint.h>
#include <stdio.h>

#include <deque>

enum { LOW, HIGH, OUTPUT, LED_BUILTIN = 13 };
static uint32_t now = 0;
static uint32_t millis() { return now; }
static void pinMode(int, int) {}
static void digitalWrite(int, int) {}
static void analogWriteResolution(int) {}
static void analogWriteFrequency(int, float) {}
static void analogWrite(int pin, int ticks) { printf("pulse %d %d\n", pin, ticks); }
template <class T> T constrain(T value, T low, T high) { return value < low ? low : value > high ? high : value; }

struct SerialPort {
  std::deque<uint8_t> input;
  void begin(long) {}
  int available() { return (int)input.size(); }
  int availableForWrite() { return 64; }
  int read() { uint8_t byte = input.front(); input.pop_front(); return byte; }
  void write(const uint8_t *bytes, int count) {
    printf("sent ");
    for (int i = 0; i < count; i++) printf("%02x", bytes[i]);
    printf("\n");
  }
} Serial;

#include "../../firmware/morpheyes_servo/morpheyes_servo.ino"

int main() {
  char verb[8], text[4096];
  setup();
  while (scanf("%7s %4095s", verb, text) == 2) {
    unsigned value;
    if (verb[0] == 'm' && sscanf(text, "%u", &value) == 1) {
      while (value--) { now++; loop(); }
    } else {
      for (int i = 0; sscanf(text + i, "%2x", &value) == 1; i += 2) Serial.input.push_back((uint8_t)value);
      loop();
    }
    printf("done\n");
  }
  return 0;
}
