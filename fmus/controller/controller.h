/* The generated step, in CasADi's calling convention: inputs and outputs by pointer, `iw` and `w` scratch. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

/* u -> x(0), fault */
int controller_start(const double **arg, double **res, int *iw, double *w, int mem);
/* x(k), u -> x(k+1), y, fault */
int controller_step(const double **arg, double **res, int *iw, double *w, int mem);

#endif
