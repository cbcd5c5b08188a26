/* The arithmetic of one closed-loop period and nothing else: the limit of `kinematic` with `ukf_mfac`.
   An arm of its own for each run: forward kinematics and Jacobian, joint lag, one period of command delay, noise from
   a table, the Kalman filter whose rows share their covariance, the law mfac, the speed limit. Prints ns a period. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { N = 6, M = 3, NOISE = 1 << 16 };
static const double DT = 0.05, KEPT = 0.36787944117144233, RHO = 0.287, LAMBDA = 0.00163;
static const double WALK = 1.0404e-4, NOISE_VARIANCE = 2e-6, LEAST = 0.002, LIMIT = 1.0;
static double noise[NOISE];

typedef struct {
    double fixed[N + 1][3][4], tool[3], camera[3][4], goal[M];
    double q[N], v[N], sent[N], J[M][N], P[N][N], seen_q[N], seen_y[M];
} Run;

static void see(const Run *r, double y[M], double Jy[M][N]) {
    double T[3][4], axis[N][3], place[N][3], ball[3], column[3];
    for (int i = 0; i < 3; i++) for (int j = 0; j < 4; j++) T[i][j] = r->fixed[0][i][j];
    for (int k = 0; k < N; k++) {
        double c = cos(r->q[k]), s = sin(r->q[k]), U[3][4];
        for (int i = 0; i < 3; i++) {
            axis[k][i] = T[i][2], place[k][i] = T[i][3];
            double x = T[i][0], z = T[i][1];
            T[i][0] = x * c + z * s, T[i][1] = z * c - x * s;
        }
        for (int i = 0; i < 3; i++) for (int j = 0; j < 4; j++) {
            U[i][j] = j == 3 ? T[i][3] : 0.0;
            for (int l = 0; l < 3; l++) U[i][j] += T[i][l] * r->fixed[k + 1][l][j];
        }
        for (int i = 0; i < 3; i++) for (int j = 0; j < 4; j++) T[i][j] = U[i][j];
    }
    for (int i = 0; i < 3; i++) {
        ball[i] = T[i][3];
        for (int l = 0; l < 3; l++) ball[i] += T[i][l] * r->tool[l];
    }
    for (int i = 0; i < M; i++) {
        y[i] = 0.0;
        for (int l = 0; l < 3; l++) y[i] += r->camera[l][i] * (ball[l] - r->camera[l][3]);
    }
    for (int k = 0; k < N; k++) {
        double d[3] = {ball[0] - place[k][0], ball[1] - place[k][1], ball[2] - place[k][2]};
        for (int i = 0; i < 3; i++)
            column[i] = axis[k][(i + 1) % 3] * d[(i + 2) % 3] - axis[k][(i + 2) % 3] * d[(i + 1) % 3];
        for (int i = 0; i < M; i++)
            Jy[i][k] = r->camera[0][i] * column[0] + r->camera[1][i] * column[1] + r->camera[2][i] * column[2];
    }
}

static void learn(Run *r, const double dq[N], const double dy[M]) {
    double PH[N], K[N], AH[N], S = NOISE_VARIANCE;
    for (int i = 0; i < N; i++) r->P[i][i] += WALK;
    for (int i = 0; i < N; i++) { PH[i] = 0.0; for (int j = 0; j < N; j++) PH[i] += r->P[i][j] * dq[j]; S += dq[i] * PH[i]; }
    for (int i = 0; i < N; i++) K[i] = PH[i] / S;
    for (int i = 0; i < N; i++) for (int j = 0; j < N; j++) r->P[i][j] -= K[i] * PH[j];
    for (int i = 0; i < N; i++) { AH[i] = NOISE_VARIANCE * K[i]; for (int j = 0; j < N; j++) AH[i] -= r->P[i][j] * dq[j]; }
    for (int i = 0; i < N; i++) for (int j = 0; j < N; j++) r->P[i][j] += AH[i] * K[j];
    for (int i = 0; i < M; i++) {
        double miss = dy[i];
        for (int j = 0; j < N; j++) miss -= r->J[i][j] * dq[j];
        for (int j = 0; j < N; j++) r->J[i][j] += miss * K[j];
    }
}

static void command(const Run *r, const double y[M], double u[N]) {
    double A[M][M + 1], most = 1.0;
    for (int i = 0; i < M; i++) {
        for (int j = 0; j < M; j++) { A[i][j] = i == j ? LAMBDA : 0.0; for (int k = 0; k < N; k++) A[i][j] += r->J[i][k] * r->J[j][k]; }
        A[i][M] = RHO * (r->goal[i] - y[i]);
    }
    for (int i = 0; i < M; i++) for (int l = 0; l < M; l++) if (l != i) {
        double share = A[l][i] / A[i][i];
        for (int j = i; j <= M; j++) A[l][j] -= share * A[i][j];
    }
    for (int k = 0; k < N; k++) {
        u[k] = 0.0;
        for (int i = 0; i < M; i++) u[k] += r->J[i][k] * A[i][M] / A[i][i];
        u[k] /= DT;
        if (fabs(u[k]) / LIMIT > most) most = fabs(u[k]) / LIMIT;
    }
    for (int k = 0; k < N; k++) u[k] /= most;
}

int main(int count, char **arguments) {
    int runs = count > 1 ? atoi(arguments[1]) : 1000, periods = 200, at = 0;
    Run *all = calloc((size_t)runs, sizeof(Run));
    for (int i = 0; i < NOISE; i++) noise[i] = 1e-3 * sqrt(-2.0 * log((rand() + 1.0) / (RAND_MAX + 1.0))) * cos(6.283185307 * rand() / RAND_MAX);
    const double a[N] = {0, -0.425, -0.39225, 0, 0, 0}, d[N] = {0.089159, 0, 0, 0.10915, 0.09465, 0.0823};
    const double twist[N] = {1.570796, 0, 0, 1.570796, -1.570796, 0}, home[N] = {0.1, -1.5, -2.2, 0.9, 1.2, 0.0};
    for (int n = 0; n < runs; n++) {
        Run *r = &all[n];
        for (int i = 0; i < 3; i++) r->fixed[0][i][i] = 1.0, r->camera[i][i] = 1.0;
        for (int k = 0; k < N; k++) {
            double c = cos(twist[k]), s = sin(twist[k]), F[3][4] = {{1, 0, 0, a[k]}, {0, c, -s, 0}, {0, s, c, d[k] + 20 * noise[(n + k) % NOISE]}};
            for (int i = 0; i < 3; i++) for (int j = 0; j < 4; j++) r->fixed[k + 1][i][j] = F[i][j];
        }
        r->tool[2] = 0.1;
        for (int k = 0; k < N; k++) r->q[k] = r->seen_q[k] = home[k], r->P[k][k] = 4.65e-5;
        see(r, r->seen_y, r->J);
        for (int i = 0; i < M; i++) r->goal[i] = r->seen_y[i] + 100 * noise[(n + i) % NOISE];
    }
    double left = 0.0;
    clock_t began = clock();
    for (int n = 0; n < runs; n++) for (int k = 0; k < periods; k++) {
        Run *r = &all[n];
        double y[M], Jy[M][N], dq[N], dy[M], u[N], moved = 0.0;
        see(r, y, Jy);
        for (int i = 0; i < M; i++) y[i] += noise[at = (at + 1) % NOISE], dy[i] = y[i] - r->seen_y[i], r->seen_y[i] = y[i];
        for (int i = 0; i < N; i++) dq[i] = r->q[i] - r->seen_q[i], r->seen_q[i] = r->q[i], moved += dq[i] * dq[i];
        if (moved >= LEAST * LEAST) learn(r, dq, dy);
        command(r, y, u);
        for (int i = 0; i < N; i++) {
            r->q[i] += DT * (1 - KEPT) * r->v[i] + DT * KEPT * r->sent[i];
            r->v[i] = KEPT * r->v[i] + (1 - KEPT) * r->sent[i], r->sent[i] = u[i];
        }
        if (k == periods - 1) for (int i = 0; i < M; i++) left += fabs(r->goal[i] - y[i]) / (M * runs);
    }
    printf("%.0f %.4f\n", 1e9 * (double)(clock() - began) / CLOCKS_PER_SEC / runs / periods, left);
    free(all);
    return 0;
}
