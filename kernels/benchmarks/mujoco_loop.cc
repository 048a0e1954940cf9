// MuJoCo's mj_inverse in as many threads as asked: nanoseconds of processor time an evaluation.
#include <mujoco/mujoco.h>

#include <cstdlib>
#include <ctime>
#include <iostream>
#include <random>
#include <thread>
#include <vector>

int main(int, char** argv) {
  char error[1000] = "";
  mjModel* model = mj_loadXML(argv[1], nullptr, error, sizeof error);
  if (!model) {
    std::cerr << error << std::endl;
    return 1;
  }
  model->opt.disableflags |= mjDSBL_CONSTRAINT | mjDSBL_CONTACT;
  const int samples = std::atoi(argv[2]), count = std::atoi(argv[3]), dof = model->nv;
  std::vector<double> states(size_t(samples) * 3 * dof);
  std::mt19937 random(0);
  for (double& x : states) x = std::uniform_real_distribution<double>(-3, 3)(random);
  std::vector<double> sums(count, 0);  // read and printed, so that nothing is left out
  std::vector<mjData*> data;
  for (int t = 0; t < count; ++t) data.push_back(mj_makeData(model));
  const std::clock_t start = std::clock();  // of this process, all threads together
  std::vector<std::thread> threads;
  for (int t = 0; t < count; ++t)
    threads.emplace_back([&, t] {
      mjData* d = data[t];
      for (int i = t; i < samples; i += count) {
        const double* x = &states[size_t(i) * 3 * dof];
        mju_copy(d->qpos, x, dof);
        mju_copy(d->qvel, x + dof, dof);
        mju_copy(d->qacc, x + 2 * dof, dof);
        mj_inverse(model, d);
        sums[t] += d->qfrc_inverse[0];
      }
    });
  for (auto& thread : threads) thread.join();
  const double spent = 1e9 * double(std::clock() - start) / CLOCKS_PER_SEC;
  double sum = 0;
  for (double s : sums) sum += s;
  std::cout << spent / samples << " " << sum << std::endl;
}
