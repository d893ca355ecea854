/* Limits of this board. Check the first block against your valves before flashing.
 *
 * Pressures are in the wire's unit, 10 Pa: 0.35 bar is 3500. The host compares these values with its robot file
 * and refuses to arm a board that differs. */
#ifndef LIMITS_H
#define LIMITS_H

#include "protocol.h"

/* ---- To be set for your valves ----------------------------------------------------------------------------- */

/* READ IT FROM THE LABEL OF YOUR VALVES: the pressure at full command (10 V), here 3 bar. */
#ifndef P_FULL
#define P_FULL 30000UL
#endif

/* Pressure at activation 0 and 1; above P_MAX no set-point is accepted. */
#define P_MIN 800
#define P_MAX 3500

/* Fastest change of any output, in 10 Pa per second (20000 is 2 bar/s): set-points and ramped venting alike. */
#ifndef SLEW
#define SLEW 20000U
#endif

/* Pressure sensors: the output without pressure, and the output at the pressure SENSOR_FULL; linear between. Millivolts
 * are those at a supply of 5 V. Which channels have a sensor: pins.h. An input withstands 5 V at most: a monitor output
 * of 0-10 V needs a divider by two.
 *   0-5 V, 1 bar: 0, 5000, 10000.   0.5-4.5 V, 1 bar: 500, 4500, 10000.   3 bar valve, divider: 0, 5000, 30000. */
#ifndef SENSOR_ZERO_MV
#define SENSOR_ZERO_MV 0
#endif
#ifndef SENSOR_FULL_MV
#define SENSOR_FULL_MV 5000
#endif
#ifndef SENSOR_FULL
#define SENSOR_FULL 10000
#endif

/* An output outside these millivolts is a broken wire or sensor: halfway from the sensor's range to 0 V and to 5 V. */
#define SENSOR_LEAST_MV (SENSOR_ZERO_MV / 2)
#define SENSOR_MOST_MV (SENSOR_FULL_MV / 2 + 2500)

/* The chip's reference voltage, 1100 mV within 10 %, by which the supply is measured. To calibrate it, multiply it by
 * the supply at a voltmeter and divide by the supply in the run log. */
#ifndef REFERENCE_MV
#define REFERENCE_MV 1100
#endif

/* ---- Safety times and margins ------------------------------------------------------------------------------ */

#define LINK_TIMEOUT_MS 300     /* no valid frame of the session: ramp vent */
#define CONTROL_TIMEOUT_MS 1000 /* the control loop's tick stands still: ramp vent */
#define P_OVER (P_MAX + 1000)   /* a sensor above this ... */
#define OVER_PRESSURE_MS 100    /* ... for this time: dump */
#define P_DISAGREE 500          /* a sensor this far from the applied pressure ... */
#define DISAGREE_MS 2000        /* ... for this time: ramp vent (below: leak; above: sensor or valve stuck) */
#define P_DOWN 500           /* a channel that measures this or more holds pressure: no arming, no fault is cleared */
#define SENSOR_MS 100        /* a sensor outside its plausible range for this time: ramp vent */
#define SUPPLY_LEAST_MV 4500 /* a supply below this ... */
#define SUPPLY_MS 100        /* ... for this time: ramp vent */

#define FIRMWARE_VERSION 2

/* From millivolts to 10 Pa. */
#define SENSOR_SPAN_MV ((int32_t)SENSOR_FULL_MV - SENSOR_ZERO_MV)
#define SENSOR_PRESSURE(millivolt) ((int32_t)(((millivolt) - (int64_t)SENSOR_ZERO_MV) * SENSOR_FULL / SENSOR_SPAN_MV))
#define SENSOR_LEAST SENSOR_PRESSURE(SENSOR_LEAST_MV)
#define SENSOR_MOST SENSOR_PRESSURE(SENSOR_MOST_MV)

/* Pressure of a converter reading of 10 bits, in 1/4096 of 10 Pa: SENSOR_SLOPE * reading + SENSOR_OFFSET. */
#define SENSOR_SLOPE ((int32_t)(5000 * 4LL * SENSOR_FULL / SENSOR_SPAN_MV))
#define SENSOR_OFFSET ((int32_t)(-4096LL * SENSOR_ZERO_MV * SENSOR_FULL / SENSOR_SPAN_MV))

/* After a lost link a ramp from P_MAX must end 670 ms after the last frame; the loop takes up to 40 ms of that. */
_Static_assert(LINK_TIMEOUT_MS + 1000UL * P_MAX / SLEW <= 630, "SLEW is too slow to vent in time");
_Static_assert(0 < P_MIN && P_MIN < P_MAX && P_OVER < P_FULL, "limits out of order: P_MIN < P_MAX < P_OVER < P_FULL");
_Static_assert(0 <= SENSOR_ZERO_MV && SENSOR_ZERO_MV + 1000L <= SENSOR_FULL_MV && SENSOR_FULL_MV <= 5000,
               "range of a sensor: at least 1000 mV, from 0 to 5 V");
_Static_assert(P_OVER < SENSOR_FULL && SENSOR_FULL <= 100000,
               "the sensors cannot see an over-pressure, or above 10 bar");
_Static_assert(1000 <= REFERENCE_MV && REFERENCE_MV <= 1200, "the chip's reference is 1.0 to 1.2 V");
_Static_assert(SENSOR_LEAST > -32767, "a broken sensor wire is not detected");
_Static_assert(LINK_TIMEOUT_MS >= 2 * PROTOCOL_HEARTBEAT_PERIOD_MS, "one late heartbeat must not trip the link timer");

#endif
