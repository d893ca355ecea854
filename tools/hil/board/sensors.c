/* Pressure sensors that follow their valves with a first-order lag in emulated time, without the host. */
#include "harness.h"

#include <math.h>

#include "limits.h"
#include "pins.h"

static double duty_now[MAX_CHANNELS];
static double tau_us;
static struct {
  bool follows;
  double level_mv;
  unsigned sent_mv;
} sensor[ADC_CHANNELS];

void sensors_on_duty(unsigned channel, double duty) { duty_now[channel] = duty; }

void sensors_hold(unsigned input, unsigned millivolt) {
  sensor[input].follows = false;
  board_set_adc(input, millivolt);
}

void sensors_follow(double tau_ms) {
  tau_us = 1000 * tau_ms;
  for (unsigned input = 0; input < ADC_CHANNELS; input++) {
    sensor[input].follows = SENSORS >> input & 1;
    sensor[input].sent_mv = ~0u;
  }
}

void sensors_advance(double elapsed_us) {
  for (unsigned input = 0; input < ADC_CHANNELS; input++) {
    if (!sensor[input].follows) {
      continue;
    }
    double target_mv = SENSOR_ZERO_MV + duty_now[input] * P_FULL * SENSOR_MV_PER_UNIT;
    sensor[input].level_mv += (target_mv - sensor[input].level_mv) * -expm1(-elapsed_us / tau_us);
    unsigned level_mv = (unsigned)fmin(sensor[input].level_mv + 0.5, ADC_FULL_MV);
    if (level_mv != sensor[input].sent_mv) {
      board_set_adc(input, sensor[input].sent_mv = level_mv);
    }
  }
}
