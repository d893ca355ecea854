/* Pressure sensors and supply voltage. One conversion at a time; no function waits for it. */
#ifndef SENSORS_H
#define SENSORS_H

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

struct sensors {
  int16_t measured[PROTOCOL_CHANNELS]; /* 10 Pa; PROTOCOL_NOT_MEASURED without a sensor or before its first reading */
  uint16_t supply_mv;                  /* 5 V rail; 0 before its first reading */
  uint8_t input;                       /* in conversion */
  uint8_t rounds;                      /* since the last measurement of the supply */
};

void sensors_begin(struct sensors *sensors);

/* Takes the result of the last conversion and starts the next. Returns false if no conversion has ended. */
bool sensors_poll(struct sensors *sensors);

#ifdef __cplusplus
}
#endif
#endif
