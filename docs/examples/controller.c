/* A controller's loop in C that knows docs/wire.md, zenoh-pico and cJSON, and nothing else.
 *
 * At its own rate it looks at the newest track and acts on it, or holds: one line each time that this changes.
 *
 *     controller RIG ENDPOINT [SECONDS]         controller lab tcp/127.0.0.1:7447
 *
 * Link with zenoh-pico (1.x) and cJSON. docs/wire.md says with which versions it was run. */

#define _POSIX_C_SOURCE 200809L

#include <cjson/cJSON.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <zenoh-pico.h>

#define LOOP_NS 10000000LL /* 100 Hz */
#define MAX_AGE_MS 100.0
#define LINE 256

/* The newest payload, handed from Zenoh's thread to the loop. */
typedef struct {
    pthread_mutex_t mutex;
    char *payload;
    long long received_ns;
    bool alive;
} newest_t;

static long long now_ns(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

/* Both run in Zenoh's thread: take the payload and leave. */
static void on_track(z_loaned_sample_t *sample, void *context) {
    newest_t *newest = context;
    long long received_ns = now_ns(CLOCK_MONOTONIC);
    z_owned_string_t text;
    if (z_bytes_to_string(z_sample_payload(sample), &text) < 0) return;
    char *payload = strndup(z_string_data(z_loan(text)), z_string_len(z_loan(text)));
    z_drop(z_move(text));
    pthread_mutex_lock(&newest->mutex);
    free(newest->payload);
    newest->payload = payload;
    newest->received_ns = received_ns;
    pthread_mutex_unlock(&newest->mutex);
}

static void on_liveliness(z_loaned_sample_t *sample, void *context) {
    newest_t *newest = context;
    pthread_mutex_lock(&newest->mutex);
    newest->alive = z_sample_kind(sample) == Z_SAMPLE_KIND_PUT;
    pthread_mutex_unlock(&newest->mutex);
}

/* What to do now, in one line. A track that cannot be read is no track. */
static void judge(const cJSON *track, bool alive, long long received_ns, char line[LINE]) {
    const cJSON *version = cJSON_GetObjectItemCaseSensitive(track, "version");
    const char *status = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(track, "status"));
    if (!alive) {
        snprintf(line, LINE, "hold: no daemon");
    } else if (!cJSON_IsNumber(version) || version->valueint != 1 || status == NULL) {
        snprintf(line, LINE, "hold: no track of version 1");
    } else if (strcmp(status, "ok") != 0) {
        const cJSON *reason = cJSON_GetArrayItem(cJSON_GetObjectItemCaseSensitive(track, "reasons"), 0);
        snprintf(line, LINE, "hold: %s (%s)", status, cJSON_IsString(reason) ? reason->valuestring : "");
    } else {
        /* At least: what this host saw pass, and what the daemon says had passed before. */
        const cJSON *latency = cJSON_GetObjectItemCaseSensitive(track, "latency_ms");
        double age_ms = (double)(now_ns(CLOCK_MONOTONIC) - received_ns) / 1e6;
        if (cJSON_IsNumber(latency)) age_ms += latency->valuedouble;
        const cJSON *tip = cJSON_GetObjectItemCaseSensitive(track, "tip");
        const cJSON *position = cJSON_GetObjectItemCaseSensitive(tip, "position_mm");
        if (age_ms > MAX_AGE_MS) {
            snprintf(line, LINE, "hold: the newest track is too old");
        } else if (cJSON_GetArraySize(position) != 3) {
            snprintf(line, LINE, "hold: no tip");
        } else {
            snprintf(line, LINE, "act: tip at (%.3f, %.3f, %.3f) mm", cJSON_GetArrayItem(position, 0)->valuedouble,
                     cJSON_GetArrayItem(position, 1)->valuedouble, cJSON_GetArrayItem(position, 2)->valuedouble);
        }
    }
}

int main(int argc, char **argv) {
    if (argc < 3) {
        fprintf(stderr, "usage: controller RIG ENDPOINT [SECONDS]\n");
        return 2;
    }
    const char *rig = argv[1];
    const long long until_ns = argc > 3 ? now_ns(CLOCK_MONOTONIC) + (long long)(atof(argv[3]) * 1e9) : 0;

    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, argv[2]);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MULTICAST_SCOUTING_KEY, "false");
    z_owned_session_t session;
    if (z_open(&session, z_move(config), NULL) < 0) {
        fprintf(stderr, "nobody answers at %s\n", argv[2]);
        return 1;
    }

    newest_t newest = {.mutex = PTHREAD_MUTEX_INITIALIZER};
    char key[LINE];
    z_view_keyexpr_t expression;

    snprintf(key, sizeof key, "needletrack/%s/track", rig);
    z_owned_closure_sample_t closure;
    z_owned_subscriber_t tracks, liveliness;
    z_closure(&closure, on_track, NULL, &newest);
    if (z_view_keyexpr_from_str(&expression, key) < 0 ||
        z_declare_subscriber(z_loan(session), &tracks, z_loan(expression), z_move(closure), NULL) < 0) {
        fprintf(stderr, "cannot subscribe to %s\n", key);
        return 1;
    }
    /* With history: a late joiner sees the token that is there. */
    z_liveliness_subscriber_options_t with_history;
    z_liveliness_subscriber_options_default(&with_history);
    with_history.history = true;
    char alive_key[LINE];
    snprintf(alive_key, sizeof alive_key, "needletrack/%s/alive", rig);
    z_closure(&closure, on_liveliness, NULL, &newest);
    if (z_view_keyexpr_from_str(&expression, alive_key) < 0 ||
        z_liveliness_declare_subscriber(z_loan(session), &liveliness, z_loan(expression), z_move(closure),
                                        &with_history) < 0) {
        fprintf(stderr, "cannot watch %s\n", alive_key);
        return 1;
    }

    cJSON *track = NULL;
    long long received_ns = 0;
    char line[LINE] = "", said[LINE] = "";
    for (long long due_ns = now_ns(CLOCK_MONOTONIC); until_ns == 0 || due_ns < until_ns; due_ns += LOOP_NS) {
        struct timespec due = {.tv_sec = due_ns / 1000000000LL, .tv_nsec = due_ns % 1000000000LL};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);

        pthread_mutex_lock(&newest.mutex);
        char *payload = newest.payload;
        newest.payload = NULL;
        bool alive = newest.alive;
        if (payload != NULL) received_ns = newest.received_ns;
        pthread_mutex_unlock(&newest.mutex);
        if (payload != NULL) {
            cJSON_Delete(track);
            track = cJSON_Parse(payload);
            free(payload);
        }

        judge(track, alive, received_ns, line);
        if (strcmp(line, said) != 0) {
            puts(line);
            fflush(stdout);
            strcpy(said, line);
        }
    }
    /* Closing waits for as long as nobody is there to connect to anew (zenoh-pico 1.9.0). */
    if (!newest.alive) _Exit(0);
    z_drop(z_move(tracks));
    z_drop(z_move(liveliness));
    z_drop(z_move(session));
    cJSON_Delete(track);
    free(newest.payload);
    return 0;
}
