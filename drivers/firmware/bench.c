/* A bench for the firmware: an ATmega328P under simavr, with a motor on its pins and a line to its UART.
 *
 * Time is the AVR's own cycle count and moves only in bench_run. The motor counts the rising edges of STEP by DIR and
 * closes the limit switches at the ends of its travel; every step is logged with its cycle, so that the firmware's own
 * counter has a judge. Compiled into a shared library and driven through ctypes (elpd_drivers/sim/boards/avr.py).
 */
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "board.h"

#define LOG (1u << 16)
#define QUEUE 256u

typedef struct {
    uint64_t cycle;
    int32_t way;
} step_t;

typedef struct {
    uint64_t cycle;
    uint8_t byte;
} sent_t;

typedef struct {
    avr_t *avr;
    avr_irq_t *uart_in;
    avr_irq_t *limit_min, *limit_max;
    int32_t rotor, lowest, highest;
    int upwards, enabled, iris, sync;
    uint64_t sync_edges, steps_made;
    step_t steps[LOG];
    uint32_t steps_put, steps_got;
    step_t syncs[LOG]; /* way: the level after the edge */
    uint32_t syncs_put, syncs_got;
    sent_t sent[LOG];
    uint32_t sent_put, sent_got;
    uint8_t queue[QUEUE];
    uint32_t queue_put, queue_got;
    int full;
} bench_t;

static void set_limits(bench_t *bench) {
    avr_raise_irq(bench->limit_min, bench->rotor > bench->lowest);
    avr_raise_irq(bench->limit_max, bench->rotor < bench->highest);
}

static void on_step(struct avr_irq_t *irq, uint32_t value, void *param) {
    bench_t *bench = param;
    (void)irq;
    if (!value || !bench->enabled) {
        return;
    }
    bench->steps_made++;
    bench->rotor += bench->upwards ? 1 : -1;
    step_t *step = &bench->steps[bench->steps_put++ % LOG];
    step->cycle = bench->avr->cycle;
    step->way = bench->upwards ? 1 : -1;
    set_limits(bench);
}

static void on_dir(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    ((bench_t *)param)->upwards = value != 0;
}

static void on_enable(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    ((bench_t *)param)->enabled = value == 0;
}

static void on_iris(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    ((bench_t *)param)->iris = value != 0;
}

static void on_sync(struct avr_irq_t *irq, uint32_t value, void *param) {
    bench_t *bench = param;
    (void)irq;
    if ((value != 0) != bench->sync) {
        bench->sync = value != 0;
        bench->sync_edges++;
        step_t *edge = &bench->syncs[bench->syncs_put++ % LOG];
        edge->cycle = bench->avr->cycle;
        edge->way = bench->sync;
    }
}

static void on_sent(struct avr_irq_t *irq, uint32_t value, void *param) {
    bench_t *bench = param;
    (void)irq;
    sent_t *sent = &bench->sent[bench->sent_put++ % LOG];
    sent->cycle = bench->avr->cycle;
    sent->byte = (uint8_t)value;
}

static void on_xon(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)value;
    ((bench_t *)param)->full = 0;
}

static void on_xoff(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)value;
    ((bench_t *)param)->full = 1;
}

/* Sleep costs no time of ours. */
static void no_sleep(avr_t *avr, avr_cycle_count_t cycles) {
    (void)avr;
    (void)cycles;
}

static void quiet(avr_t *avr, const int level, const char *format, va_list arguments) {
    (void)avr;
    (void)level;
    (void)format;
    (void)arguments;
}

void *bench_open(const char *elf, int32_t rotor, int32_t lowest, int32_t highest) {
    avr_global_logger_set(quiet);
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    if (elf_read_firmware(elf, &firmware)) {
        return NULL;
    }
    bench_t *bench = calloc(1, sizeof *bench);
    avr_t *avr = avr_make_mcu_by_name("atmega328p");
    if (!bench || !avr) {
        free(bench);
        return NULL;
    }
    avr_init(avr);
    firmware.frequency = F_CPU;
    avr_load_firmware(avr, &firmware);
    avr->log = LOG_NONE;
    avr->sleep = no_sleep;
    bench->avr = avr;
    bench->rotor = rotor;
    bench->lowest = lowest;
    bench->highest = highest;
    bench->enabled = 0;

    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    bench->uart_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_sent, bench);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), on_xon, bench);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), on_xoff, bench);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), STEP_BIT), on_step, bench);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), DIR_BIT), on_dir, bench);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), ENABLE_BIT), on_enable, bench);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), SYNC_BIT), on_sync, bench);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), IRIS_BIT), on_iris, bench);
    bench->limit_min = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), LIMIT_MIN_BIT);
    bench->limit_max = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), LIMIT_MAX_BIT);
    set_limits(bench);
    return bench;
}

void bench_close(void *handle) {
    bench_t *bench = handle;
    avr_terminate(bench->avr);
    free(bench->avr);
    free(bench);
}

/* Power off and on again: registers and memory are lost, the motor stays where it is. */
void bench_reset(void *handle) {
    bench_t *bench = handle;
    avr_reset(bench->avr);
    bench->queue_got = bench->queue_put;
    bench->full = 0;
    bench->enabled = 0;
    /* The reset has cleared the input registers, but not what the lines are remembered to carry; a level that does not
     * change is not passed on. */
    avr_raise_irq(bench->limit_min, bench->rotor <= bench->lowest);
    avr_raise_irq(bench->limit_max, bench->rotor >= bench->highest);
    set_limits(bench);
}

/* Put the motor somewhere else: it slipped, or was turned by hand. */
void bench_place(void *handle, int32_t rotor) {
    bench_t *bench = handle;
    if (rotor != bench->rotor) {
        bench->rotor = rotor;
        set_limits(bench);
    }
}

static avr_cycle_count_t wake(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)avr;
    (void)when;
    (void)param;
    return 0;
}

/* Run until the cycle count has reached `until`; returns 0, or -1 when the AVR has crashed. */
int bench_run(void *handle, uint64_t until) {
    bench_t *bench = handle;
    if (until > bench->avr->cycle) { /* asleep it would go on to its next interrupt, past bytes that are yet to come */
        avr_cycle_timer_register(bench->avr, until - bench->avr->cycle, wake, bench);
    }
    while (bench->avr->cycle < until) {
        while (!bench->full && bench->queue_got != bench->queue_put) {
            avr_raise_irq(bench->uart_in, bench->queue[bench->queue_got++ % QUEUE]);
        }
        int state = avr_run(bench->avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            return -1;
        }
    }
    return 0;
}

void bench_receive(void *handle, uint8_t byte) {
    bench_t *bench = handle;
    bench->queue[bench->queue_put++ % QUEUE] = byte;
}

uint64_t bench_cycle(void *handle) { return ((bench_t *)handle)->avr->cycle; }

/* Copy out what has been sent since the last call; returns how many. */
uint32_t bench_sent(void *handle, uint64_t *cycles, uint8_t *bytes, uint32_t room) {
    bench_t *bench = handle;
    uint32_t count = 0;
    for (; count < room && bench->sent_got != bench->sent_put; count++) {
        sent_t *sent = &bench->sent[bench->sent_got++ % LOG];
        cycles[count] = sent->cycle;
        bytes[count] = sent->byte;
    }
    return count;
}

/* Copy out the steps made since the last call; returns how many. */
uint32_t bench_steps(void *handle, uint64_t *cycles, int32_t *ways, uint32_t room) {
    bench_t *bench = handle;
    uint32_t count = 0;
    for (; count < room && bench->steps_got != bench->steps_put; count++) {
        step_t *step = &bench->steps[bench->steps_got++ % LOG];
        cycles[count] = step->cycle;
        ways[count] = step->way;
    }
    return count;
}

/* Copy out the edges on SYNC since the last call, each with the level after it; returns how many. */
uint32_t bench_syncs(void *handle, uint64_t *cycles, int32_t *levels, uint32_t room) {
    bench_t *bench = handle;
    uint32_t count = 0;
    for (; count < room && bench->syncs_got != bench->syncs_put; count++) {
        step_t *edge = &bench->syncs[bench->syncs_got++ % LOG];
        cycles[count] = edge->cycle;
        levels[count] = edge->way;
    }
    return count;
}

int32_t bench_rotor(void *handle) { return ((bench_t *)handle)->rotor; }
uint64_t bench_steps_made(void *handle) { return ((bench_t *)handle)->steps_made; }
uint64_t bench_sync_edges(void *handle) { return ((bench_t *)handle)->sync_edges; }
int bench_iris(void *handle) { return ((bench_t *)handle)->iris; }
int bench_enabled(void *handle) { return ((bench_t *)handle)->enabled; }
